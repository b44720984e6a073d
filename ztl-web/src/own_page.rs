//! A user's page in place of the console's, and its forms, as the original's `ztl_web` serves them.

use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use ztl_std::files;

use crate::board::Board;
use crate::clock::now_ms;
use crate::gate::Role;
use crate::goal::Goal;
use crate::goal::LATEST_MS;
use crate::goals;
use crate::lock::locked;
use crate::robots::Target;

/// A press that follows sooner belongs to the one before: a double click, or a held key.
const SAME_PRESS: Duration = Duration::from_millis(600);

/// Most bytes of a page.
const LONGEST: u64 = 16 << 20;

/// A user's page. It is read for each request, so that it can be edited while it is served.
pub struct OwnPage {
    pub(crate) path: PathBuf,
    last: Mutex<Option<(IpAddr, String, Instant)>>,
}

/// What a form asks for.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Posted {
    /// The page again.
    Page,
    /// The same host at another port.
    Port(u16),
}

impl OwnPage {
    /// The page in this file.
    ///
    /// # Errors
    /// Why it cannot be read.
    pub fn open(path: PathBuf) -> io::Result<Self> {
        Self::read(&path)?;
        Ok(Self {
            path,
            last: Mutex::default(),
        })
    }

    /// Reads the page.
    ///
    /// # Errors
    /// Why it cannot be read.
    pub(crate) fn read(path: &Path) -> io::Result<Vec<u8>> {
        files::read(path, LONGEST)
    }

    /// A form was sent. Only its first field counts: `port`, or `handler:component` with the goal as its value.
    ///
    /// # Errors
    /// Why nothing was done.
    pub(crate) fn post(
        &self,
        board: &Arc<Board>,
        form: &[u8],
        role: Role,
        address: IpAddr,
    ) -> Result<Posted, (StatusCode, String)> {
        let (name, value) = first_field(form).ok_or_else(|| {
            let why = "expected a form with a field handler:component or port";
            (StatusCode::BAD_REQUEST, format!("{why}\n"))
        })?;
        if name == "port" {
            let port = value.parse().map_err(|_| {
                let why = format!("invalid port '{value}': expected 0 to 65535\n");
                (StatusCode::BAD_REQUEST, why)
            })?;
            return Ok(Posted::Port(port));
        }
        let mut words = name.split(':');
        let (Some(handler), Some(component), None) = (words.next(), words.next(), words.next())
        else {
            tracing::warn!("no command: a field '{name}'");
            return Ok(Posted::Page);
        };
        let Some(target) = target(board, handler, component) else {
            tracing::warn!("no robot '{handler}' for a field '{name}'");
            return Ok(Posted::Page);
        };
        let refused = |status: StatusCode, why: String| Err((status, format!("NOT SENT: {why}\n")));
        if role != Role::Operator {
            return refused(StatusCode::FORBIDDEN, "a watcher only looks".to_owned());
        }
        if let Some(operator) = board.operator.now() {
            return refused(StatusCode::CONFLICT, format!("{} operates", operator.by()));
        }
        if self.is_same_press(address, &format!("{name}={value}")) {
            return Ok(Posted::Page);
        }
        let (by, not_after) = (format!("page at {address}"), now_ms() + LATEST_MS);
        let goal = Arc::new(Goal::new(target, value, by, not_after));
        match goals::start(&goal, board, Box::new(|_| {})) {
            Ok(()) => Ok(Posted::Page),
            Err(why) => refused(StatusCode::SERVICE_UNAVAILABLE, why),
        }
    }

    fn is_same_press(&self, address: IpAddr, form: &str) -> bool {
        let mut last = locked(&self.last);
        let same = last.as_ref().is_some_and(|(from, what, at)| {
            *from == address && what == form && at.elapsed() < SAME_PRESS
        });
        *last = Some((address, form.to_owned(), Instant::now()));
        same
    }
}

/// The component that a form means. A form names a robot where a task names a handler.
fn target(board: &Board, robot: &str, component: &str) -> Option<Target> {
    let mut servers = board.servers.iter().enumerate();
    let (server, scope) = servers.find_map(|(index, of)| Some((index, of.scope_of(robot)?)))?;
    Some(Target {
        server,
        scope: scope.to_owned(),
        handler: robot.to_owned(),
        component: component.to_owned(),
    })
}

/// The first field of a form and its value.
fn first_field(form: &[u8]) -> Option<(String, String)> {
    let field = form.split(|byte| *byte == b'&').next()?;
    let mut parts = field.splitn(2, |byte| *byte == b'=');
    Some((decoded(parts.next()?)?, decoded(parts.next()?)?))
}

/// Decodes a form's text: `+` is a space, `%` begins other bytes.
fn decoded(text: &[u8]) -> Option<String> {
    let mut bytes = Vec::new();
    let mut left = text;
    while let Some((first, rest)) = left.split_first() {
        left = rest;
        bytes.push(match first {
            b'+' => b' ',
            b'%' => {
                let (code, rest) = left.split_at_checked(2)?;
                left = rest;
                let mut digits = code.iter().map(|digit| char::from(*digit).to_digit(16));
                let value = digits.try_fold(0, |value, digit| Some(value * 16 + digit?));
                u8::try_from(value?).ok()?
            }
            other => *other,
        });
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_field_of_a_form_is_decoded() {
        let field = |form: &str| first_field(form.as_bytes());
        let pair = |name: &str, value: &str| Some((name.to_owned(), value.to_owned()));
        assert_eq!(
            field("arm%3Aleft=a+b%26%C3%BC&x=y"),
            pair("arm:left", "a b&ü")
        );
        assert_eq!(field("port=1061"), pair("port", "1061"));
        assert_eq!(field("a=b=c"), pair("a", "b=c"));
        assert_eq!(field("a="), pair("a", ""));
        for wrong in [
            "",
            "a",
            "a=%",
            "a=%2",
            "a=%zz",
            "a=%+1",
            "a=%ff",
            "{\"a\": 1}",
        ] {
            assert_eq!(field(wrong), None, "{wrong}");
        }
    }
}
