//! What the servers have confirmed about a Stop. The thread of each server ([`server_thread`](crate::server_thread)) aborts its
//! tasks, and decides whether the server has confirmed that nothing runs.

use std::sync::Mutex;

use serde_json::{Value, json};
use tokio::sync::watch;

use crate::clock::now_ms;
use crate::cut;
use crate::lock::locked;

/// All presses of Stop. A press during another one joins it: each server that has decided looks again.
pub(crate) struct Stops {
    state: Mutex<Presses>,
    /// The last press for which every server has decided.
    decided: watch::Sender<u64>,
}

struct Presses {
    /// How often Stop was pressed.
    pressed: u64,
    /// Who pressed it last, and when.
    by: String,
    at_ms: u64,
    servers: Vec<Decision>,
}

/// Whether a server has confirmed that nothing runs.
struct Decision {
    name: String,
    /// For which press it is decided.
    press: u64,
    confirmed: bool,
    text: String,
}

impl Stops {
    pub(crate) fn new(names: impl Iterator<Item = String>) -> Self {
        let undecided = |name| Decision {
            name,
            press: 0,
            confirmed: false,
            text: String::new(),
        };
        Self {
            state: Mutex::new(Presses {
                pressed: 0,
                by: String::new(),
                at_ms: 0,
                servers: names.map(undecided).collect(),
            }),
            decided: watch::Sender::new(0),
        }
    }

    /// Stop is pressed; returns the number of this press.
    pub(crate) fn press(&self, by: &str) -> u64 {
        let mut state = locked(&self.state);
        state.pressed += 1;
        by.clone_into(&mut state.by);
        state.at_ms = now_ms();
        state.pressed
    }

    /// Whether a server has something to decide.
    pub(crate) fn are_under_way(&self) -> bool {
        let state = locked(&self.state);
        state
            .servers
            .iter()
            .any(|server| server.press < state.pressed)
    }

    /// The last press, if this server has not decided for it.
    pub(crate) fn undecided(&self, server: usize) -> Option<u64> {
        let state = locked(&self.state);
        let known = state.servers.get(server)?.press;
        (known < state.pressed).then_some(state.pressed)
    }

    /// What a server has confirmed for a press, or why it has not.
    pub(crate) fn decide(&self, server: usize, press: u64, told: Result<String, String>) {
        let mut state = locked(&self.state);
        if let Some(decision) = state.servers.get_mut(server) {
            decision.press = press;
            decision.confirmed = told.is_ok();
            decision.text = cut::text(&told.unwrap_or_else(|why| why), 4 * cut::LINE);
        }
        let all = state.servers.iter().map(|server| server.press).min();
        // While the state is locked: a later decision must not be told before an earlier one.
        self.decided.send_replace(all.unwrap_or_default());
    }

    /// As the topic shows it: `confirmed` is `null` where the last press is not decided.
    pub(crate) fn shown(&self) -> Value {
        self.told(None)
    }

    /// Waits until every server has decided for a press.
    pub(crate) async fn answer(&self, press: u64) -> Value {
        let mut decided = self.decided.subscribe();
        // Fails only if the sender is gone, which `self` holds.
        let _ = decided.wait_for(|decided| *decided >= press).await;
        self.told(Some(press))
    }

    fn told(&self, press: Option<u64>) -> Value {
        let state = locked(&self.state);
        if state.pressed == 0 {
            return json!({});
        }
        let press = press.unwrap_or(state.pressed);
        let robot = |server: &Decision| {
            let (confirmed, text) = match server.press >= press {
                true => (Some(server.confirmed), server.text.as_str()),
                false => (None, "no answer yet"),
            };
            json!({ "robot": server.name, "confirmed": confirmed, "text": text })
        };
        let robots: Vec<Value> = state.servers.iter().map(robot).collect();
        json!({ "by": state.by, "at_ms": state.at_ms, "robots": robots })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decisions_at_the_same_time_are_told() {
        let stops = Stops::new((0..8).map(|server| server.to_string()));
        for _ in 0..500 {
            let press = stops.press("one");
            std::thread::scope(|scope| {
                for server in 0..8 {
                    let stops = &stops;
                    scope.spawn(move || stops.decide(server, press, Ok(String::new())));
                }
            });
            assert_eq!(*stops.decided.borrow(), press);
        }
    }

    #[test]
    fn a_second_press_reopens_what_is_decided() {
        let stops = Stops::new(["a", "b"].map(str::to_owned).into_iter());
        assert_eq!(stops.shown(), json!({}));
        assert!(!stops.are_under_way());
        let first = stops.press("one");
        stops.decide(0, first, Ok("nothing ran".to_owned()));
        assert_eq!(
            (stops.undecided(0), stops.undecided(1)),
            (None, Some(first))
        );
        let second = stops.press("two");
        assert_eq!(stops.undecided(0), Some(second));
        assert_eq!(stops.shown()["robots"][0]["confirmed"], Value::Null);
        stops.decide(1, first, Err("silent".to_owned()));
        assert_eq!(*stops.decided.borrow(), first);
        stops.decide(0, second, Ok(String::new()));
        stops.decide(1, second, Err("silent".to_owned()));
        assert!(!stops.are_under_way());
        let shown = stops.shown();
        assert_eq!(
            (&shown["by"], &shown["robots"][1]["text"]),
            (&json!("two"), &json!("silent"))
        );
    }
}
