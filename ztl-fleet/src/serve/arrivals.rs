//! What waits for the thread of the streams, in bounds: each robot has room of its own, and its turn.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_core::Instant;
use ztl_std::relay::WantedTopic;

use crate::wire::Verdict;

/// Bytes of messages of one robot that wait. Further ones are dropped, and missed.
const ROOM: usize = 8 << 20;
/// Bytes of the messages of all robots above which each has the smaller room.
const ALL: usize = 64 << 20;
const SMALL: usize = 256 << 10;

/// What is known of a robot's agent.
#[derive(Debug, Clone)]
pub(super) struct Known {
    pub(super) agent: String,
    /// Its boot, and its clock in milliseconds when it was heard.
    pub(super) clock: (u32, u64, Instant),
    pub(super) scopes: Vec<String>,
}

/// What has happened.
#[derive(Debug, Default)]
pub(super) struct News {
    pub(super) wanted: Option<Vec<WantedTopic>>,
    /// Robots that are there or gone, and whether they were gone meanwhile.
    pub(super) robots: BTreeMap<String, (bool, Option<Known>)>,
    /// Robots, questions, and the answer to each or its end.
    pub(super) replies: VecDeque<(String, u64, Option<Verdict>)>,
    /// At most one of each robot.
    pub(super) messages: Vec<(String, Vec<u8>)>,
}

#[derive(Debug, Default)]
struct Queue {
    agent: String,
    messages: VecDeque<Vec<u8>>,
    bytes: usize,
}

#[derive(Debug, Default)]
struct State {
    news: News,
    /// The robots that are listened to.
    queues: BTreeMap<String, Queue>,
    bytes: usize,
}

/// What waits.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    state: Mutex<State>,
    some: Condvar,
}

impl Arrivals {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn put_wanted(&self, wanted: Vec<WantedTopic>) {
        self.state().news.wanted = Some(wanted);
        self.some.notify_one();
    }

    /// A robot with streams is there, or gone.
    pub(super) fn put_robot(&self, name: &str, known: Option<Known>) {
        let mut state = self.state();
        let news = state.news.robots.entry(name.to_owned()).or_default();
        news.0 |= known.is_none();
        news.1 = known;
        drop(state);
        self.some.notify_one();
    }

    pub(super) fn put_reply(&self, name: String, question: u64, verdict: Option<Verdict>) {
        let mut state = self.state();
        state.news.replies.push_back((name, question, verdict));
        drop(state);
        self.some.notify_one();
    }

    /// A message, unless nobody wants it or too many wait.
    pub(super) fn put_message(&self, robot: &str, agent: &str, payload: impl FnOnce() -> Vec<u8>) {
        let mut state = self.state();
        let State { queues, bytes, .. } = &mut *state;
        let queue = queues.get_mut(robot);
        let Some(queue) = queue.filter(|queue| queue.agent == agent) else {
            return;
        };
        let room = if *bytes < ALL { ROOM } else { SMALL };
        if queue.bytes >= room {
            return;
        }
        let payload = payload();
        queue.bytes += payload.len();
        *bytes += payload.len();
        queue.messages.push_back(payload);
        drop(state);
        self.some.notify_one();
    }

    /// Takes messages of these robots and agents only.
    pub(super) fn listen(&self, mut agents: BTreeMap<String, String>) {
        let mut state = self.state();
        let State { queues, bytes, .. } = &mut *state;
        queues.retain(|robot, queue| {
            let keeps = agents.get(robot) == Some(&queue.agent);
            match keeps {
                true => drop(agents.remove(robot)),
                false => *bytes -= queue.bytes,
            }
            keeps
        });
        for (robot, agent) in agents {
            let queue = Queue {
                agent,
                ..Queue::default()
            };
            queues.insert(robot, queue);
        }
    }

    /// What has happened, if anything does within `limit`; messages only if there is room for them.
    pub(super) fn next(&self, has_room: bool, limit: Duration) -> News {
        let is_quiet = |state: &mut State| {
            let news = &state.news;
            let has_messages = has_room && state.bytes > 0;
            news.wanted.is_none()
                && news.robots.is_empty()
                && news.replies.is_empty()
                && !has_messages
        };
        let waited = self.some.wait_timeout_while(self.state(), limit, is_quiet);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let State {
            news,
            queues,
            bytes,
        } = &mut *state;
        let mut news = std::mem::take(news);
        if has_room {
            for (robot, queue) in queues {
                if let Some(message) = queue.messages.pop_front() {
                    queue.bytes -= message.len();
                    *bytes -= message.len();
                    news.messages.push((robot.clone(), message));
                }
            }
        }
        news
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listening(robots: &[&str]) -> Arrivals {
        let arrivals = Arrivals::default();
        let agent = |robot: &&str| ((*robot).to_owned(), "7".to_owned());
        arrivals.listen(robots.iter().map(agent).collect());
        arrivals
    }

    fn next(arrivals: &Arrivals) -> Vec<(String, usize)> {
        let news = arrivals.next(true, Duration::ZERO);
        let messages = news.messages.into_iter();
        messages.map(|(robot, body)| (robot, body.len())).collect()
    }

    #[test]
    fn a_flood_of_one_robot_is_bounded_and_delays_no_other() {
        let arrivals = listening(&["arm", "leg"]);
        for _ in 0..100 {
            arrivals.put_message("arm", "7", || vec![0; 1 << 20]);
        }
        arrivals.put_message("leg", "7", || vec![0; 3]);
        assert_eq!(
            next(&arrivals),
            [("arm".to_owned(), 1 << 20), ("leg".to_owned(), 3)]
        );
        let rest = std::iter::from_fn(|| Some(next(&arrivals)).filter(|next| !next.is_empty()));
        assert_eq!(rest.count(), (ROOM >> 20) - 1);
    }

    #[test]
    fn many_floods_leave_room_for_a_quiet_robot() {
        let names: Vec<String> = (0..20).map(|number| format!("arm-{number:02}")).collect();
        let mut robots: Vec<&str> = names.iter().map(String::as_str).collect();
        robots.push("quiet");
        let arrivals = listening(&robots);
        for robot in &names {
            for _ in 0..20 {
                arrivals.put_message(robot, "7", || vec![0; 1 << 20]);
            }
        }
        assert!(arrivals.state().bytes < ALL + (names.len() << 20));
        arrivals.put_message("quiet", "7", || vec![1]);
        assert!(next(&arrivals).contains(&("quiet".to_owned(), 1)));
    }

    #[test]
    fn a_robot_that_was_gone_for_a_moment_was_gone() {
        let arrivals = listening(&[]);
        let known = || {
            Some(Known {
                agent: "7".to_owned(),
                clock: (1, 2, Instant::ZERO),
                scopes: Vec::new(),
            })
        };
        let next = || {
            let mut robots = arrivals.next(true, Duration::ZERO).robots;
            robots
                .remove("arm")
                .map(|(was_gone, known)| (was_gone, known.is_some()))
        };
        arrivals.put_robot("arm", known());
        assert_eq!(next(), Some((false, true)));
        arrivals.put_robot("arm", None);
        arrivals.put_robot("arm", known());
        assert_eq!(next(), Some((true, true)));
        assert_eq!(next(), None);
    }

    #[test]
    fn only_the_agent_that_was_asked_is_heard() {
        let arrivals = listening(&["arm"]);
        arrivals.put_message("arm", "8", || vec![1]);
        arrivals.put_message("leg", "7", || vec![1]);
        assert!(next(&arrivals).is_empty());
        arrivals.put_message("arm", "7", || vec![1]);
        arrivals.listen(BTreeMap::new());
        assert!(next(&arrivals).is_empty());
        assert_eq!(arrivals.state().bytes, 0);
        // While the publisher is full, messages wait.
        let arrivals = listening(&["arm"]);
        arrivals.put_message("arm", "7", || vec![1]);
        assert!(arrivals.next(false, Duration::ZERO).messages.is_empty());
        assert_eq!(next(&arrivals).len(), 1);
    }
}
