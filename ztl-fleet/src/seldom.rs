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
        self.may_at(Instant::now())
    }

    fn may_at(&self, now: Instant) -> bool {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let may = last.is_none_or(|last| has_paused(last, now));
        if may {
            *last = Some(now);
        }
        may
    }
}

/// Whether another line may follow that of `last`.
fn has_paused(last: Instant, now: Instant) -> bool {
    now.saturating_duration_since(last) >= PAUSE
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
        self.may_at(who, Instant::now())
    }

    fn may_at(&self, who: &K, now: Instant) -> bool {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MOST {
            all.retain(|_, last| !has_paused(*last, now));
        }
        let may = match all.get(who) {
            Some(last) => has_paused(*last, now),
            None => all.len() < MOST,
        };
        if may {
            all.insert(who.clone(), now);
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
        let (seldom, now) = (Seldom::default(), Instant::now());
        assert!(seldom.may_at(now) && !seldom.may_at(now));
        assert!(seldom.may_at(now + PAUSE));
    }

    #[test]
    fn a_flood_by_one_hides_no_line_of_another() {
        let (seldom, now) = (SeldomOf::default(), Instant::now());
        let may = |who: &usize| seldom.may_at(who, now);
        assert!(may(&1) && !may(&1) && may(&2));
        let written = (3..2 * MOST).filter(may).count();
        assert_eq!(written, MOST - 2);
        assert!(seldom.may_at(&1, now + PAUSE));
    }
}
