//! One request and its answer. Whatever the server does, it ends within its time and takes bounded memory.

use std::fmt;
use std::io::{ErrorKind, Read as _};
use std::time::{Duration, Instant};

use ureq::http::{Method, Request, Response, Uri};
use ureq::unversioned::resolver::DefaultResolver;
use ureq::{Agent, Body, Error, Timeout};
use ztl_std::describe::GoalValue;

use super::dial::{Closer, Dial, NotOpened};
use super::request::Filled;

/// The longest answer that is read, in bytes.
pub(super) const LONGEST: usize = 64 << 10;
/// How long a connection may take to open.
pub(super) const CONNECT: Duration = Duration::from_secs(5);
/// How many redirects are followed.
const REDIRECTS: usize = 3;

/// An answer, or an event.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) status: u16,
    /// The name of an event.
    pub(super) name: Option<String>,
    body: Vec<u8>,
    /// Whether it goes on after `body`.
    cut: bool,
    /// Where a redirect leads that was not followed.
    location: Option<String>,
    value: Option<GoalValue>,
}

/// Why there is no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct NoAnswer {
    pub(super) reason: String,
    /// Whether the server may have done what was asked.
    pub(super) sent: bool,
}

impl fmt::Display for NoAnswer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.reason)
    }
}

impl Answer {
    /// An event with this text or JSON.
    pub(super) fn of_event(name: Option<String>, body: &[u8]) -> Self {
        Self {
            status: 200,
            name,
            body: body.to_vec(),
            cut: false,
            location: None,
            value: serde_json::from_slice(body).ok(),
        }
    }

    /// The bytes of its texts.
    pub(super) fn len(&self) -> usize {
        self.body.len() + self.name.as_ref().map_or(0, String::len)
    }

    /// Its JSON; `None` if it is none.
    pub(super) const fn value(&self) -> Option<&GoalValue> {
        self.value.as_ref()
    }

    /// The value of a field of its JSON.
    pub(super) fn field(&self, path: &[String]) -> Option<GoalValue> {
        let value = self.value.as_ref();
        value
            .and_then(|value| path.iter().try_fold(value, |value, key| value.part(key)))
            .cloned()
    }

    /// What it was, for a task that fails of it.
    pub(super) fn failure(&self) -> String {
        let (status, text) = (self.status, self.text());
        match &self.location {
            Some(location) if (300..400).contains(&status) => {
                format!("status {status}, which leads to '{location}' and is not followed: {text}")
            }
            _ => format!("status {status}: {text}"),
        }
    }

    /// The whole answer: JSON as the original writes values, or its text.
    pub(super) fn text(&self) -> String {
        let written = self.value.as_ref().and_then(|value| value.to_text().ok());
        let mut text = written.unwrap_or_else(|| {
            let text = String::from_utf8_lossy(&self.body);
            text.trim_end().to_owned()
        });
        if self.cut {
            text.push_str(" … (cut)");
        }
        text
    }
}

/// Sends a request, and waits for its answer until `until`. Redirects are followed to the same host only, and only where
/// that does not repeat something that was done.
pub(super) fn exchange(request: &Filled, until: Instant) -> Result<Answer, NoAnswer> {
    let mut uri = request.uri.clone();
    for _ in 0..=REDIRECTS {
        let mut answer = send(request, &uri, until)?;
        let status = answer.status().as_u16();
        let same_method = matches!(status, 307 | 308)
            || (request.method == Method::GET && matches!(status, 301..=303));
        let location = answer.headers().get("location");
        let location = location.and_then(|location| location.to_str().ok());
        let location = location.map(str::to_owned);
        let Some(location) = location.clone().filter(|_| same_method) else {
            let answer = read(status, answer.body_mut(), until)?;
            return Ok(Answer { location, ..answer });
        };
        uri = redirected(&uri, &location).ok_or_else(|| NoAnswer {
            reason: format!(
                "status {status} leads to '{location}', which is another host, port or scheme"
            ),
            sent: false,
        })?;
    }
    Err(NoAnswer {
        reason: format!("it was redirected more than {REDIRECTS} times"),
        sent: false,
    })
}

fn send(request: &Filled, uri: &Uri, until: Instant) -> Result<Response<Body>, NoAnswer> {
    let left = until.saturating_duration_since(Instant::now());
    if left.is_zero() {
        return Err(NoAnswer {
            reason: "there was no time left for it".to_owned(),
            sent: false,
        });
    }
    let closer = Closer::default();
    let dial = Dial {
        trust: request.trust.clone(),
        closer: closer.clone(),
        silence: None,
    };
    let answer = connection(request, uri, dial, Some(left));
    answer.map_err(|error| {
        let error = no_answer(&error);
        NoAnswer {
            sent: error.sent && closer.has_opened(),
            ..error
        }
    })
}

/// Sends a request on a connection of its own, and waits for the beginning of the answer. `limit`: how long all of it may
/// take; without, the body may take any time.
pub(super) fn connection(
    request: &Filled,
    uri: &Uri,
    dial: Dial,
    limit: Option<Duration>,
) -> Result<Response<Body>, Error> {
    let config = Agent::config_builder()
        .http_status_as_error(false)
        .max_redirects(0)
        // An idle connection may be closed while a request is sent on it: then nobody could say what was done.
        .max_idle_connections(0)
        // A robot is in the same network.
        .proxy(None)
        .max_response_header_size(LONGEST)
        .timeout_connect(Some(limit.map_or(CONNECT, |limit| CONNECT.min(limit))))
        .timeout_recv_response(limit.or(Some(CONNECT)))
        .timeout_global(limit)
        .build();
    let mut builder = Request::builder().method(request.method.clone()).uri(uri);
    for (name, value) in &request.headers {
        builder = builder.header(name, value);
    }
    let agent = Agent::with_parts(config, dial, DefaultResolver::default());
    match &request.body {
        Some(body) => agent.run(builder.body(body.as_slice())?),
        None => agent.run(builder.body(())?),
    }
}

fn read(status: u16, body: &mut Body, until: Instant) -> Result<Answer, NoAnswer> {
    let mut reader = body.as_reader();
    let mut bytes = Vec::new();
    let mut buffer = [0; 4096];
    let incomplete = |reason: String| NoAnswer {
        reason: format!("status {status}, and its answer did not end: {reason}"),
        sent: true,
    };
    let mut cut = false;
    loop {
        // An answer that drips would otherwise never end.
        if Instant::now() >= until {
            return Err(incomplete("the time is over".to_owned()));
        }
        match reader.read(&mut buffer) {
            Ok(0) => break,
            Ok(count) => {
                bytes.extend_from_slice(buffer.get(..count).unwrap_or_default());
                if bytes.len() > LONGEST {
                    bytes.truncate(LONGEST);
                    cut = true;
                    break;
                }
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(incomplete(error.to_string())),
        }
    }
    let value = match cut {
        true => None,
        false => serde_json::from_slice(&bytes).ok(),
    };
    Ok(Answer {
        status,
        name: None,
        body: bytes,
        cut,
        location: None,
        value,
    })
}

/// Where a redirect leads, if that is on the same host, at the same port and as encrypted as before.
fn redirected(from: &Uri, location: &str) -> Option<Uri> {
    let authority = from.authority()?;
    let scheme = from.scheme_str()?;
    let path = from.path();
    let begin = location.split(['/', '?', '#']).next()?;
    let absolute = match location.chars().next()? {
        _ if begin.ends_with(':') => location.to_owned(),
        '/' if location.starts_with("//") => format!("{scheme}:{location}"),
        '/' => format!("{scheme}://{authority}{location}"),
        '?' => format!("{scheme}://{authority}{path}{location}"),
        _ => {
            let (directory, _) = path.rsplit_once('/')?;
            format!("{scheme}://{authority}{directory}/{location}")
        }
    };
    let to: Uri = absolute.parse().ok()?;
    let same = to.authority() == Some(authority) && to.scheme_str() == Some(scheme);
    same.then_some(to)
}

pub(super) fn no_answer(error: &Error) -> NoAnswer {
    let (sent, reason) = match error {
        Error::HostNotFound => (false, "no such host".to_owned()),
        Error::ConnectionFailed => (false, "cannot connect".to_owned()),
        Error::Other(cause) if cause.is::<NotOpened>() => (false, cause.to_string()),
        Error::Timeout(Timeout::Resolve) => (false, "its name was not found in time".to_owned()),
        Error::Timeout(Timeout::Connect) => (false, "cannot connect in time".to_owned()),
        Error::Timeout(_) => (true, "no answer in time".to_owned()),
        Error::BadUri(_) | Error::Http(_) | Error::Tls(_) => (false, error.to_string()),
        Error::Io(cause) if cause.kind() == ErrorKind::UnexpectedEof => {
            (true, "the server has closed the connection".to_owned())
        }
        Error::Io(cause) => (true, cause.to_string()),
        _ => (true, error.to_string()),
    };
    NoAnswer { reason, sent }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_stay_on_their_host() {
        let from: Uri = "http://10.0.0.7:80/a?b".parse().expect("an address");
        for (location, to) in [
            ("/c", Some("http://10.0.0.7:80/c")),
            ("http://10.0.0.7:80/d", Some("http://10.0.0.7:80/d")),
            ("http://10.0.0.8:80/d", None),
            ("https://10.0.0.7:80/d", None),
            ("//10.0.0.8/d", None),
            ("//10.0.0.7:80/e", Some("http://10.0.0.7:80/e")),
            ("c", Some("http://10.0.0.7:80/c")),
            ("../c?d", Some("http://10.0.0.7:80/../c?d")),
            ("?d", Some("http://10.0.0.7:80/a?d")),
            ("c?d=http://e", Some("http://10.0.0.7:80/c?d=http://e")),
            ("mailto:x", Some("http://10.0.0.7:80/mailto:x")),
            ("", None),
        ] {
            let found = redirected(&from, location).map(|uri| uri.to_string());
            assert_eq!(found.as_deref(), to, "{location}");
        }
    }
}
