//! Limits what strangers can write into the log.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Pause between two lines.
const PAUSE: Duration = Duration::from_secs(1);

/// Most robots and keys about which lines were written within [`PAUSE`].
const MOST: usize = 1000;

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
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let may = last.is_none_or(|last| last.elapsed() >= PAUSE);
        if may {
            *last = Some(Instant::now());
        }
        may
    }
}

/// Lets one line a second pass of each robot or key, so that a flood by one of them hides nothing of another.
#[derive(Debug)]
pub struct SeldomOf<K>(Mutex<BTreeMap<K, Instant>>);

impl<K> Default for SeldomOf<K> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K: Ord + Clone> SeldomOf<K> {
    /// Whether a line about `who` may be written now.
    #[must_use]
    pub fn may(&self, who: &K) -> bool {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MOST {
            all.retain(|_, last| last.elapsed() < PAUSE);
        }
        let may = match all.get(who) {
            Some(last) => last.elapsed() >= PAUSE,
            None => all.len() < MOST,
        };
        if may {
            all.insert(who.clone(), Instant::now());
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

    #[test]
    fn a_flood_by_one_hides_no_line_of_another() {
        let seldom = SeldomOf::default();
        assert!(seldom.may(&1) && !seldom.may(&1) && seldom.may(&2));
        let written = (3..2 * MOST).filter(|who| seldom.may(who)).count();
        assert!(written < 2 * MOST - 3, "{written}");
    }
}
