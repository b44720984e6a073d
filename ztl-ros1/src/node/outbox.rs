//! What waits to be sent on a connection, and what the other end has not acknowledged yet.

use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::sync::Arc;
use std::time::{Duration, Instant};

use mio::net::TcpStream;

use super::unacknowledged::{self, Ends, Missing};

/// A large message may take longer: as if the network carried this many bytes a second.
const SLOWEST: usize = 1 << 20;

/// Messages that wait to be sent. With a limit, also those that the other end has not acknowledged.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    waiting: VecDeque<Message>,
    /// Bytes of the first one that were handed to the system.
    begun: usize,
    /// How long the other end may take to acknowledge a message.
    limit: Option<Duration>,
    /// All bytes that were handed to the system since there is a limit.
    handed_over: u64,
    /// Messages that were handed to the system: where each ends among these bytes, and its deadline.
    in_flight: VecDeque<(u64, Instant)>,
}

#[derive(Debug)]
struct Message {
    bytes: Arc<[u8]>,
    /// When it is too late to deliver it, if there is a limit.
    deadline: Option<Instant>,
}

impl Outbox {
    /// From now on, a message must be acknowledged within this time. If it is not, [`deadline`](Self::deadline) passes.
    pub(crate) fn limit(&mut self, limit: Duration) {
        self.limit = Some(self.limit.map_or(limit, |before| before.min(limit)));
    }

    pub(crate) const fn has_limit(&self) -> bool {
        self.limit.is_some()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Whether all was sent, and acknowledged if there is a limit.
    pub(crate) fn is_settled(&self) -> bool {
        self.waiting.is_empty() && self.in_flight.is_empty()
    }

    /// Adds a message. If `most` messages wait already, drops the oldest; returns whether it did.
    pub(crate) fn push(&mut self, now: Instant, bytes: Arc<[u8]>, most: usize) -> bool {
        // A message whose sending has begun must be completed.
        let begun = usize::from(self.begun > 0);
        let full = self.waiting.len() >= most.max(1) + begun;
        if full {
            self.waiting.remove(begun);
        }
        let deadline = self.limit.map(|limit| {
            let millis = bytes.len().saturating_mul(1000) / SLOWEST;
            now + limit + Duration::from_millis(u64::try_from(millis).unwrap_or(u64::MAX))
        });
        self.waiting.push_back(Message { bytes, deadline });
        full
    }

    /// Hands over to the system what it accepts.
    ///
    /// # Errors
    /// If the connection is broken.
    pub(crate) fn flush(&mut self, stream: &mut TcpStream) -> io::Result<()> {
        while let Some(message) = self.waiting.front() {
            let rest = message.bytes.get(self.begun..).unwrap_or_default();
            let count = match stream.write(rest) {
                Ok(count) => count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) if is_later(&error) => return Ok(()),
                Err(error) => return Err(error),
            };
            self.begun += count;
            let is_whole = count == rest.len();
            if self.limit.is_some() {
                self.handed_over += u64::try_from(count).unwrap_or_default();
                if let Some(deadline) = message.deadline.filter(|_| is_whole) {
                    self.in_flight.push_back((self.handed_over, deadline));
                }
            }
            if is_whole {
                self.waiting.pop_front();
                self.begun = 0;
            }
        }
        Ok(())
    }

    /// Forgets what the other end has acknowledged; `table` says how much it has not.
    pub(crate) fn acknowledge(&mut self, ends: Option<Ends>, table: &mut unacknowledged::Table) {
        if self.in_flight.is_empty() {
            return;
        }
        let missing = match ends.map_or(Missing::Untold, |ends| table.bytes(ends)) {
            Missing::Bytes(bytes) => bytes,
            // Where the system does not tell, what was handed over counts as acknowledged.
            Missing::Untold => 0,
            // It has closed the connection, and nobody will ever know.
            Missing::Gone => return,
        };
        let acknowledged = self.handed_over.saturating_sub(missing);
        while let Some((end, _)) = self.in_flight.front()
            && *end <= acknowledged
        {
            self.in_flight.pop_front();
        }
    }

    /// When the oldest message is too late.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let in_flight = self.in_flight.front().map(|(_, deadline)| *deadline);
        in_flight.or_else(|| self.waiting.front().and_then(|message| message.deadline))
    }
}

/// Whether a call would have to wait: also while the connection is being made.
pub(crate) fn is_later(error: &io::Error) -> bool {
    use io::ErrorKind::{NotConnected, WouldBlock};
    matches!(error.kind(), WouldBlock | NotConnected)
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream as Blocking};

    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn what_was_in_flight_when_the_system_closed_the_connection_is_never_acknowledged() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let theirs = Blocking::connect(listener.local_addr().unwrap()).unwrap();
        let (ours, to) = listener.accept().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut ours = TcpStream::from_std(ours);
        let ends = Ends::of(&ours, to);
        let mut outbox = Outbox::default();
        outbox.limit(Duration::from_secs(60));
        outbox.push(Instant::now(), Arc::from([0; 10]), 1);
        outbox.flush(&mut ours).unwrap();
        assert!(!outbox.is_settled());
        theirs.peek(&mut [0; 10]).unwrap();
        // Closed with something unread: the system resets the connection.
        drop(theirs);
        while unacknowledged::Table::default().bytes(ends.unwrap()) != Missing::Gone {
            std::thread::yield_now();
        }
        outbox.acknowledge(ends, &mut unacknowledged::Table::default());
        assert!(!outbox.is_settled());
        outbox.acknowledge(None, &mut unacknowledged::Table::default());
        assert!(outbox.is_settled(), "the system does not tell");
    }
}
