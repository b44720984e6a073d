//! One node of a bus: what waits for it, and when it is asked next.

use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{NO_SEQ, Turn};

use super::BusEvent;
use crate::session::BusNeeds;

/// How often a node with tasks has its turn: no more often if it has nothing to say, and no less often if the line is fast
/// enough for all, apart from the question that is under way.
const BUSY: (Duration, Duration) = (Duration::from_millis(32), Duration::from_millis(42));
/// A node with tasks has its turn at the latest after this.
const LATEST: Duration = Duration::from_millis(50);
/// A node without tasks.
const REST: (Duration, Duration) = (Duration::from_millis(200), Duration::from_millis(250));
/// A node that does not answer this often in a row is asked less often.
const SILENCE: u32 = 3;
/// A node whose answers were damaged is well again after so many intact ones in a row.
const INTACT: u32 = 20;
/// Pause before a silent node is asked again: doubled up to the longest.
const BACK_OFF: Duration = Duration::from_millis(50);
const BACK_OFF_MOST: Duration = Duration::from_millis(800);

/// A command that waits for the line.
#[derive(Debug, Clone)]
struct Waiting {
    bytes: Vec<u8>,
    /// A `Start` or an `Abort`.
    urgent: bool,
    since: Instant,
}

/// A question, and when it is asked.
pub(super) struct Next {
    /// Whether the node may choose its frame; otherwise it answers a command.
    pub(super) poll: bool,
    /// Not before this.
    pub(super) ready: Instant,
    /// If the line allows it, by this time.
    pub(super) due: Instant,
    /// Whether it goes before the questions for all other nodes.
    pub(super) urgent: bool,
}

#[derive(Debug, Clone)]
pub(super) struct Member {
    pub(super) needs: BusNeeds,
    /// Acknowledgements, which ask for no answer. They are sent with the next question.
    unasked: Vec<Vec<u8>>,
    command: Option<Waiting>,
    /// The command that the last question was; empty if it was a poll.
    sent: Vec<u8>,
    /// When it was last polled.
    polled: Instant,
    /// Whether its last answer means that it may have more to send.
    more: bool,
    silent: u32,
    garbled: u32,
    /// Whether its answers are damaged again and again, and how many in a row have been intact since.
    pub(super) damaged: bool,
    intact: u32,
    /// Whether an answer has arrived intact.
    heard: bool,
    /// It is not asked before this.
    not_before: Instant,
}

impl Member {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            needs: BusNeeds::default(),
            unasked: Vec::new(),
            command: None,
            sent: Vec::new(),
            polled: now,
            more: false,
            silent: 0,
            garbled: 0,
            damaged: false,
            intact: 0,
            heard: false,
            not_before: Instant::ZERO,
        }
    }

    /// Queues a frame with its delimiter.
    pub(super) fn queue(&mut self, now: Instant, frame: &[u8]) {
        let Some([_, seq, tag]) = head(frame) else {
            return;
        };
        // A `Hello` has no sequence number, but asks.
        if seq == NO_SEQ && tag != 0 {
            if !self.unasked.iter().any(|queued| queued == frame) {
                self.unasked.push(frame.to_vec());
            }
            return;
        }
        let before = self.command.take();
        let since = before.filter(|before| before.bytes == frame);
        self.command = Some(Waiting {
            bytes: frame.to_vec(),
            urgent: seq != NO_SEQ && matches!(tag, 2 | 3),
            since: since.map_or(now, |before| before.since),
        });
    }

    /// What it can be asked next: whether it has something to send, and a command that waits.
    pub(super) fn next(&self) -> impl Iterator<Item = Next> {
        let (least, most) = if self.needs.busy { BUSY } else { REST };
        let at_once = self.more || !self.unasked.is_empty();
        let pause = if at_once { Duration::ZERO } else { least };
        let poll = Next {
            poll: true,
            ready: (self.polled + pause).max(self.not_before),
            due: self.polled + most,
            urgent: false,
        };
        let command = self.command.as_ref().map(|command| {
            let urgent = command.urgent || self.needs.urgent;
            Next {
                poll: false,
                ready: command.since.max(self.not_before),
                due: command.since
                    + if urgent {
                        Duration::ZERO
                    } else {
                        self.needs.patience
                    },
                urgent,
            }
        });
        command.into_iter().chain([poll])
    }

    /// Whether a command can be sent.
    pub(super) fn has_command(&self, now: Instant) -> bool {
        self.command.is_some() && self.not_before <= now
    }

    /// When it has its turn at the latest, if it has tasks and answers.
    pub(super) fn latest(&self) -> Option<Instant> {
        let answers = self.needs.busy && self.silent < SILENCE;
        answers.then(|| self.polled + LATEST)
    }

    /// Whether one of its last answers has arrived intact.
    pub(super) const fn answers(&self) -> bool {
        self.heard && self.silent < SILENCE && self.garbled < SILENCE
    }

    /// Takes the frames of the next question.
    pub(super) fn take(&mut self, now: Instant, address: u8, poll: bool) -> Vec<Vec<u8>> {
        let mut frames = std::mem::take(&mut self.unasked);
        match self.command.take_if(|_| !poll) {
            Some(command) => {
                self.sent.clone_from(&command.bytes);
                frames.push(command.bytes);
            }
            None => {
                self.polled = now;
                self.sent.clear();
                frames.push(Turn::Poll.encode(address).to_vec());
            }
        }
        frames
    }

    /// Handles an answer of the node at this address. Returns whether its answers are damaged from now on, or no longer.
    pub(super) fn on_answer(&mut self, address: u8, valid: bool, idle: bool) -> Option<BusEvent> {
        self.silent = 0;
        self.not_before = Instant::ZERO;
        // A repetition that was queued meanwhile; the session repeats it again if the answer was damaged.
        self.command.take_if(|command| command.bytes == self.sent);
        self.more = valid && !idle;
        self.heard |= valid;
        (self.garbled, self.intact) = match valid {
            true => (0, self.intact + u32::from(self.damaged)),
            false => (SILENCE.min(self.garbled + 1), 0),
        };
        match self.damaged {
            false if self.garbled >= SILENCE => {
                self.damaged = true;
                Some(BusEvent::Garbled(address))
            }
            true if self.intact >= INTACT => {
                (self.damaged, self.intact) = (false, 0);
                Some(BusEvent::Intact(address))
            }
            _ => None,
        }
    }

    /// Handles that there was no answer. Returns whether the node has just become silent.
    pub(super) fn on_silence(&mut self, now: Instant) -> bool {
        self.more = false;
        self.silent = self.silent.saturating_add(1);
        if let Some(times) = self.silent.checked_sub(SILENCE) {
            let pause = BACK_OFF * 2u32.saturating_pow(times.min(8));
            self.not_before = now + pause.min(BACK_OFF_MOST);
        }
        self.silent == SILENCE
    }
}

/// The first three bytes of a frame: address, sequence number, and the tag of the message.
fn head(frame: &[u8]) -> Option<[u8; 3]> {
    let mut head = [0; 3];
    let mut bytes = frame.iter();
    let mut left = bytes.next()?.checked_sub(1)?;
    for decoded in &mut head {
        let byte = *bytes.next()?;
        if left > 0 {
            left -= 1;
            *decoded = byte;
        } else {
            // The end of a piece stands for a zero; this byte begins the next piece.
            left = byte.checked_sub(1)?;
        }
    }
    Some(head)
}
