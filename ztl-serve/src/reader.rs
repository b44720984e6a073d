//! Reads a configuration file: what all its parts need.

mod templates;

use std::path::Path;
use std::time::Duration;

use ztl_yaml::{Diagnostic, Document, Node, Reading};

use ztl_std::describe::GoalRule;
use ztl_std::keys::exposure;

#[cfg(feature = "http")]
use crate::http::hosts::Hosts;
use crate::naoqi::names::Naoqi;
use crate::ros1::connection::Ros1;

/// A file that is being read.
pub(crate) struct ConfigReader<'d> {
    pub(crate) document: &'d Document,
    /// The directory that paths are relative to.
    pub(crate) base: &'d Path,
    pub(crate) yaml: Reading<'d>,
    pub(crate) warnings: Vec<Diagnostic>,
    pub(crate) ros1: Ros1,
    pub(crate) naoqi: Naoqi,
    #[cfg(feature = "http")]
    pub(crate) http: Hosts,
    /// Whether what is read is used after a robot's answer, so that it may use its fields.
    pub(crate) knows_answer: bool,
}

/// What is known of a component when its kind is read.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ComponentContext<'a> {
    pub(crate) rule: &'a GoalRule,
    /// Whether clients choose the name of the handler or the component, since it is `*`.
    pub(crate) wildcard: bool,
}

impl<'d> ConfigReader<'d> {
    /// A reader at the beginning of a document; paths are relative to `base`.
    pub(crate) fn new(document: &'d Document, base: &'d Path) -> Self {
        Self {
            document,
            base,
            yaml: document.reading(),
            warnings: Vec::new(),
            ros1: Ros1::default(),
            naoqi: Naoqi::default(),
            #[cfg(feature = "http")]
            http: Hosts::default(),
            knows_answer: false,
        }
    }

    /// The entries of a mapping, which must not be empty.
    pub(crate) fn non_empty(&mut self, node: &'d Node, what: &str) -> &'d [(Node, Node)] {
        let pairs = self.yaml.pairs(node, what);
        if pairs.is_some_and(<[_]>::is_empty) {
            self.yaml
                .wrong(node, format!("this is empty; expected {what}"));
        }
        pairs.unwrap_or_default()
    }

    /// The name of a handler or component, as it stands between two `:` in a request.
    pub(crate) fn name(&mut self, node: &'d Node, what: &str) -> Option<String> {
        self.yaml.parsed(node, what, |text| {
            let fits = !text.is_empty() && !text.contains(':') && !text.contains(char::is_control);
            match fits {
                true => Ok(text.to_owned()),
                false => Err(format!(
                    "invalid name '{text}' for {what}: expected no ':' and no control characters"
                )),
            }
        })
    }

    pub(crate) fn count(&mut self, node: &'d Node, most: usize) -> Option<usize> {
        let what = format!("a whole number from 1 to {most}");
        self.yaml.parsed(node, &what, |text| {
            let number = text.parse().ok();
            let number = number.filter(|number| (1..=most).contains(number));
            number.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }

    pub(crate) fn time(&mut self, node: &'d Node, most: Duration) -> Option<Duration> {
        let what = "a time, as 30 s, 300 ms or 5 min";
        let time = self.yaml.parsed(node, what, |text| {
            let time = humantime::parse_duration(text);
            time.map_err(|_| format!("'{text}' is not {what}"))
        })?;
        if time > most || time.is_zero() {
            let mut message = "this must be greater than zero".to_owned();
            if most < Duration::MAX {
                let most = humantime::format_duration(most);
                message.push_str(&format!(" and at most {most}"));
            }
            self.yaml.wrong(node, message);
            return None;
        }
        Some(time)
    }

    /// A time that must not be less than so many seconds, and why.
    pub(crate) fn at_least(&mut self, node: &'d Node, seconds: u64, why: &str) -> Option<Duration> {
        let time = self.time(node, Duration::MAX)?;
        if time < Duration::from_secs(seconds) {
            self.yaml
                .wrong(node, format!("this must be at least {seconds}s: {why}"));
            return None;
        }
        Some(time)
    }

    /// The time between two of something that has a rate.
    pub(crate) fn rate(&mut self, node: &'d Node) -> Option<Duration> {
        let what = "a rate from 0.001 Hz to 1000 Hz, as 10 Hz";
        self.yaml.parsed(node, what, |text| {
            let number = text.strip_suffix("Hz").map(str::trim_end);
            let rate = number.and_then(|number| number.parse::<f64>().ok());
            let rate = rate.filter(|rate| (0.001..=1000.0).contains(rate));
            let interval = rate.map(|rate| Duration::from_secs_f64(1.0 / rate));
            interval.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }

    /// Warns if others can read the file of a secret.
    pub(crate) fn warn_if_exposed(&mut self, node: &'d Node, secret: &Path) {
        if let Some(exposure) = exposure(secret) {
            self.warn(node, exposure);
        }
    }

    /// Adds a warning: the file can be served, but perhaps not as intended.
    pub(crate) fn warn(&mut self, node: &'d Node, message: String) {
        let message = format!("warning: {message}");
        self.warnings
            .push(self.document.mistake(node.span, message));
    }
}
