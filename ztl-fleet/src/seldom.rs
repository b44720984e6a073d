//! Limits what strangers can write into the log.

use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Pause between two lines.
const PAUSE: Duration = Duration::from_secs(1);

/// Longest text of strangers in a line, in characters.
const LONGEST: usize = 100;

/// The beginning of a text, on one line.
#[must_use]
pub fn brief(text: &str) -> String {
    let text: String = text.chars().take(LONGEST).collect();
    ztl_std::terminal::flat(&text).into_owned()
}

/// Lets one line a second pass.
#[derive(Debug, Default)]
pub struct Seldom(Mutex<Option<Instant>>);

impl Seldom {
    /// Whether a line may be written now.
    #[must_use]
    pub fn may(&self) -> bool {
        let mut last = self
            .0
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let may = last.is_none_or(|last| last.elapsed() >= PAUSE);
        if may {
            *last = Some(Instant::now());
        }
        may
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_strangers_say_takes_one_short_line() {
        assert_eq!(brief("/lab"), "/lab");
        assert_eq!(brief("a\nb\u{1b}[2J"), "a\\nb\\u001b[2J");
        assert_eq!(brief(&"x".repeat(1000)).len(), LONGEST);
        let seldom = Seldom::default();
        assert!(seldom.may() && !seldom.may());
    }
}
