//! What a server is asked seldom: what its components say of themselves, and its devices.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_std::{DescribeQuestions, server_answer};

use super::{Answer, Asked, ServerThread};
use crate::clock::now_ms;
use crate::devices::Devices;

/// How often a server is asked what its components say of themselves, if nothing has changed.
const DESCRIBE: Duration = Duration::from_secs(5);
/// How often it is asked for its devices.
const DEVICES: Duration = Duration::from_secs(2);

impl ServerThread<'_> {
    /// Asks what the components say of themselves.
    pub(super) fn describe(&mut self) {
        if let (None, Some(requests)) = (&self.describing, &mut self.requests) {
            let questions = DescribeQuestions::of_server();
            requests.ask_server(Asked::Describe, questions.question());
            self.describing = Some((questions, DefaultHasher::new()));
            self.next_describe = Instant::now() + DESCRIBE;
        }
    }

    pub(super) fn on_described(&mut self, answer: Answer) {
        let Some((mut questions, mut hash)) = self.describing.take() else {
            return;
        };
        let answer = match server_answer(answer) {
            Ok(answer) => answer.unwrap_or_default(),
            Err(_) => {
                self.next_describe = Instant::now();
                return;
            }
        };
        answer.hash(&mut hash);
        match (questions.on_answer(&answer), &mut self.requests) {
            (true, Some(requests)) => {
                requests.ask_server(Asked::Describe, questions.question());
                self.describing = Some((questions, hash));
            }
            _ => {
                let scopes = questions.into_scopes();
                let number = match scopes.is_empty() {
                    true => 0,
                    // A number that JavaScript can tell from others.
                    false => hash.finish() >> 12 | 1,
                };
                if self.board.seen(self.index).described != Some(number) {
                    self.board
                        .set_described(self.index, number, Arc::new(scopes));
                }
            }
        }
    }

    /// Asks for the devices. Only a gateway has devices.
    pub(super) fn ask_devices(&mut self) {
        if let (None, Some(requests)) = (self.asks_devices, &mut self.requests) {
            requests.ask_server(Asked::Devices, "devices");
            let now = Instant::now();
            self.asks_devices = Some(now);
            self.next_devices = now + DEVICES;
        }
    }

    pub(super) fn on_devices(&mut self, answer: Answer) {
        let asked_at = self.asks_devices.take();
        // Without an answer, the devices are as last known, as the tasks are.
        let Ok(answer) = server_answer(answer) else {
            return;
        };
        let mut seen = self.board.seen(self.index);
        let devices = answer.map(|answer| Devices::read(&answer, &seen.devices, now_ms()));
        seen.devices = Arc::new(devices.unwrap_or_default());
        self.board.set_seen(self.index, seen);
        self.devices_at = asked_at;
        self.confirm();
    }
}
