//! One operator at a time: the client that may start tasks. Everybody may stop them.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::clock::now_ms;
use crate::gate::Role;
use crate::lock::locked;

/// A client: one socket of a page or a program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Client {
    /// Unique, also among the clients of earlier consoles.
    #[serde(rename = "client")]
    pub(crate) number: u64,
    /// Its role, its number since the console was started, and its address, for people.
    pub(crate) by: String,
    #[serde(skip)]
    pub(crate) role: Role,
}

impl Client {
    fn may_operate(&self) -> Result<(), String> {
        match self.role {
            Role::Operator => Ok(()),
            Role::Watcher => {
                Err("a watcher may only look and stop: open the operators' link".to_owned())
            }
        }
    }
}

/// Who operates.
pub(crate) struct Operator {
    /// The numbers of clients are above this one.
    before: u64,
    next: Mutex<u64>,
    now: Mutex<Option<Operates>>,
    /// When the operator was heard last.
    heard: Mutex<Instant>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Operates {
    #[serde(flatten)]
    client: Client,
    since_ms: u64,
}

impl Operator {
    pub(crate) fn new() -> Self {
        // The start time, so that numbers of a later console are higher: clients come at most once a millisecond.
        let before = now_ms();
        Self {
            before,
            next: Mutex::new(before),
            now: Mutex::default(),
            heard: Mutex::new(Instant::now()),
        }
    }

    /// A new client.
    pub(crate) fn client(&self, role: Role, address: impl std::fmt::Display) -> Client {
        let mut next = locked(&self.next);
        *next += 1;
        let count = *next - self.before;
        Client {
            number: *next,
            by: format!("{} {count} at {address}", role.name()),
            role,
        }
    }

    /// Who operates now.
    pub(crate) fn now(&self) -> Option<Operates> {
        locked(&self.now).clone()
    }

    /// Lets a client operate if nobody does. Returns whether it begins to.
    ///
    /// # Errors
    /// Why it may not start tasks.
    pub(crate) fn begin(&self, client: &Client) -> Result<bool, String> {
        client.may_operate()?;
        let mut now = locked(&self.now);
        match &*now {
            Some(other) if other.client.number != client.number => Err(format!(
                "{} operates: take over before you start tasks (/ztl/operate)",
                other.client.by
            )),
            Some(_) => Ok(false),
            None => {
                *now = Some(Operates::since_now(client));
                self.note_heard();
                Ok(true)
            }
        }
    }

    /// Makes a client the operator; with `from`, only if the client with that number is the operator.
    ///
    /// # Errors
    /// Why it does not.
    pub(crate) fn take_over(&self, client: &Client, from: Option<u64>) -> Result<(), String> {
        client.may_operate()?;
        let mut now = locked(&self.now);
        match &*now {
            Some(Operates { client: other, .. })
                if from.is_some_and(|from| from != other.number)
                    && other.number != client.number =>
            {
                Err(format!("{} has taken over before", other.by))
            }
            _ => {
                *now = Some(Operates::since_now(client));
                self.note_heard();
                Ok(())
            }
        }
    }

    /// A message of this client has come, or the answer to a ping.
    pub(crate) fn hear(&self, client: &Client) {
        let now = locked(&self.now);
        if now
            .as_ref()
            .is_some_and(|now| now.client.number == client.number)
        {
            self.note_heard();
        }
    }

    /// For how long no operator was heard.
    pub(crate) fn alone_for(&self) -> Duration {
        locked(&self.heard).elapsed()
    }

    fn note_heard(&self) {
        *locked(&self.heard) = Instant::now();
    }

    /// The client is gone. Returns whether it operated.
    pub(crate) fn leave(&self, client: &Client) -> bool {
        let mut now = locked(&self.now);
        let left = now.take_if(|now| now.client.number == client.number);
        left.is_some()
    }
}

impl Operates {
    /// Who it is, for people.
    pub(crate) fn by(&self) -> &str {
        &self.client.by
    }

    fn since_now(client: &Client) -> Self {
        Self {
            client: client.clone(),
            since_ms: now_ms(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(operator: &Operator) -> Option<u64> {
        operator.now().map(|now| now.client.number)
    }

    #[test]
    fn one_operates_until_another_takes_over() {
        let operator = Operator::new();
        let [a, b] = [(); 2].map(|()| operator.client(Role::Operator, "10.0.0.7"));
        assert_ne!(a.number, b.number);
        assert_eq!(operator.begin(&a), Ok(true));
        assert_eq!(operator.begin(&a), Ok(false));
        let refused = operator.begin(&b).expect_err("another operates");
        assert!(
            refused.starts_with("operator 1 at 10.0.0.7 operates"),
            "{refused}"
        );
        assert_eq!(operator.take_over(&b, Some(a.number)), Ok(()));
        assert!(operator.begin(&a).is_err());
        assert_eq!(number(&operator), Some(b.number));
        assert!(!operator.leave(&a));
        assert!(operator.leave(&b));
        assert_eq!(operator.begin(&a), Ok(true));
    }

    #[test]
    fn who_takes_over_from_one_does_not_take_over_from_another() {
        let operator = Operator::new();
        let [a, b, c] = [(); 3].map(|()| operator.client(Role::Operator, "10.0.0.7"));
        operator.take_over(&a, None).expect("nobody operates");
        operator.take_over(&b, Some(a.number)).expect("it operates");
        let refused = operator.take_over(&c, Some(a.number));
        assert!(refused.is_err() && number(&operator) == Some(b.number));
        assert_eq!(operator.take_over(&c, None), Ok(()));
    }

    #[test]
    fn a_watcher_never_operates() {
        let operator = Operator::new();
        let watcher = operator.client(Role::Watcher, "10.0.0.7");
        assert!(operator.begin(&watcher).is_err());
        assert!(operator.take_over(&watcher, None).is_err());
        assert_eq!(operator.now(), None);
    }
}
