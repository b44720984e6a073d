//! Publishes messages to those who subscribed to their topics: a PUB socket, on a thread of its own.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use tracing::warn;
use ztl_zmtp::Pub;

use super::peers::{PeerId, Peers, Rules, UNSENT};
use super::streams::Endpoint;
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::server::CurrentAccess;

/// Messages that wait for the thread. Further ones are dropped.
const QUEUE: usize = 1000;

/// Most subscriptions of one subscriber, and their bytes.
const SUBSCRIPTIONS: usize = 1000;
const TOPICS: usize = 64 * 1024;

/// The topic and what is published.
type Published = (String, Vec<u8>);

/// A publisher. It closes when it is dropped.
#[derive(Debug)]
pub(crate) struct Publisher {
    endpoint: String,
    /// `None` once it is to end.
    queue: Option<SyncSender<Published>>,
    waker: Arc<mio::Waker>,
    thread: Option<JoinHandle<()>>,
}

/// What the thread owns.
struct Worker {
    peers: Peers<Pub>,
    access: CurrentAccess,
    queue: Receiver<Published>,
    subscribers: BTreeMap<PeerId, Subscriber>,
}

/// The topics of one subscriber; each counts as often as it was subscribed to.
#[derive(Default)]
struct Subscriber {
    topics: BTreeMap<Vec<u8>, usize>,
    count: usize,
    bytes: usize,
}

impl Publisher {
    /// Publishes there, to those whom `access` admits.
    pub(crate) fn bind(
        endpoint: &Endpoint,
        rules: Rules,
        access: CurrentAccess,
    ) -> io::Result<Self> {
        let peers = Peers::bind(endpoint, rules)?;
        let endpoint = peers.endpoint()?;
        let waker = Arc::new(peers.waker()?);
        let (queue, queued) = sync_channel(QUEUE);
        let worker = Worker {
            peers,
            access,
            queue: queued,
            subscribers: BTreeMap::new(),
        };
        let thread = std::thread::Builder::new()
            .name("ztl-publisher".to_owned())
            .spawn(move || {
                if let Err(error) = worker.run() {
                    warn!(target: TASKS, "nothing is published any more: {error}");
                }
            })?;
        Ok(Self {
            endpoint,
            queue: Some(queue),
            waker,
            thread: Some(thread),
        })
    }

    /// Where it listens, with the port that was chosen.
    pub(crate) fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Publishes without waiting; returns whether there was room. For a subscriber that does not read, messages are
    /// dropped.
    pub(crate) fn publish(&self, topic: String, bytes: Vec<u8>) -> bool {
        let Some(queue) = &self.queue else {
            return false;
        };
        let queued = queue.try_send((topic, bytes));
        let _ = self.waker.wake();
        !matches!(queued, Err(TrySendError::Full(_)))
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.queue = None;
        let _ = self.waker.wake();
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

impl Worker {
    /// Runs until the publisher is dropped.
    fn run(mut self) -> io::Result<()> {
        use std::sync::mpsc::TryRecvError;
        loop {
            self.peers.wait(None)?;
            let access = &self.access;
            let mut admit = |address, key: Option<[u8; 32]>| {
                access.admits(address, key.map(PublicKey::from_bytes))
            };
            while let Some(message) = self.peers.next(&mut admit) {
                let body = message.body.unwrap_or_default();
                if let Some((begins @ 0..=1, topic)) = body.split_first() {
                    let subscriber = self.subscribers.entry(message.peer).or_default();
                    subscriber.change(*begins == 1, topic);
                }
            }
            let peers = &self.peers;
            self.subscribers
                .retain(|peer, _| peers.waiting(*peer).is_some());
            loop {
                match self.queue.try_recv() {
                    Ok((topic, bytes)) => self.publish(&topic, &bytes),
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => {
                        // What was published last is on its way.
                        return self.peers.wait(Some(std::time::Duration::ZERO));
                    }
                }
            }
        }
    }

    fn publish(&mut self, topic: &str, bytes: &[u8]) {
        let frame = frame(topic.as_bytes());
        for (peer, subscriber) in &self.subscribers {
            let room = self.peers.waiting(*peer).is_some_and(|waiting| {
                waiting == 0 || waiting + frame.len() + bytes.len() < UNSENT
            });
            if room && subscriber.wants(topic.as_bytes()) {
                self.peers.send(*peer, &frame, bytes);
            }
        }
    }
}

impl Subscriber {
    fn change(&mut self, begins: bool, topic: &[u8]) {
        if begins {
            if self.count == SUBSCRIPTIONS || self.bytes + topic.len() > TOPICS {
                return;
            }
            self.count += 1;
            self.bytes += topic.len();
            *self.topics.entry(topic.to_vec()).or_default() += 1;
        } else if let Some(count) = self.topics.get_mut(topic) {
            self.count -= 1;
            self.bytes -= topic.len();
            *count -= 1;
            if *count == 0 {
                self.topics.remove(topic);
            }
        }
    }

    /// Whether a topic begins with one of its topics.
    fn wants(&self, topic: &[u8]) -> bool {
        self.topics.keys().any(|wanted| topic.starts_with(wanted))
    }
}

/// A frame that announces another, as on the wire.
fn frame(body: &[u8]) -> Vec<u8> {
    let mut frame = match u8::try_from(body.len()) {
        Ok(length) => vec![1, length],
        Err(_) => [&[3][..], &(body.len() as u64).to_be_bytes()].concat(),
    };
    frame.extend_from_slice(body);
    frame
}

#[cfg(test)]
mod tests {
    use ztl_zmtp::HANDSHAKE;
    use ztl_zmtp::session::Security;

    use super::*;
    use crate::Access;

    fn publisher() -> Publisher {
        let rules = Rules {
            security: Security::Null,
            message: 1 << 20,
            connections: 50,
            handshake: HANDSHAKE,
            memory: 8 << 20,
        };
        let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
        Publisher::bind(&endpoint, rules, CurrentAccess::new(Access::everybody())).unwrap()
    }

    /// A subscriber of libzmq that holds few messages.
    fn subscriber(publisher: &Publisher, topics: &[&str]) -> zmq::Socket {
        let socket = zmq::Context::new().socket(zmq::SUB).unwrap();
        socket.set_linger(0).unwrap();
        socket.set_rcvhwm(1).unwrap();
        socket.set_rcvtimeo(20_000).unwrap();
        for topic in topics {
            socket.set_subscribe(topic.as_bytes()).unwrap();
        }
        socket.connect(publisher.endpoint()).unwrap();
        socket
    }

    /// What a subscriber gets before the first message of this topic. That one is published until it arrives.
    fn before(publisher: &Publisher, socket: &zmq::Socket, topic: &str) -> Vec<String> {
        let mut topics = Vec::new();
        for _ in 0..2_000 {
            publisher.publish(topic.to_owned(), vec![7; 3]);
            while socket.poll(zmq::POLLIN, 10).unwrap() > 0 {
                let frames = socket.recv_multipart(0).unwrap();
                let got = String::from_utf8(frames[0].clone()).unwrap();
                if got == topic {
                    assert_eq!(frames[1..], [vec![7; 3]]);
                    return topics;
                }
                topics.push(got);
            }
        }
        panic!("{topic} does not arrive");
    }

    #[test]
    fn a_subscriber_gets_its_topics_until_it_unsubscribes() {
        let publisher = publisher();
        let socket = subscriber(&publisher, &["arm/", "head/pan", "begin", "done"]);
        before(&publisher, &socket, "begin");
        let long = "arm/".to_owned() + &"x".repeat(300);
        let publish_all = || {
            for topic in ["arm/1", "leg/1", "head/tilt", "head/pan", &long, "ar"] {
                publisher.publish(topic.to_owned(), vec![1]);
            }
        };
        let heard = || {
            publish_all();
            let mut heard = before(&publisher, &socket, "done");
            heard.retain(|topic| topic != "begin" && topic != "done");
            heard
        };
        assert_eq!(heard(), ["arm/1", "head/pan", &long]);
        socket.set_unsubscribe(b"arm/").unwrap();
        let ended = (0..2_000).any(|_| heard() == ["head/pan"]);
        assert!(ended, "the topic still arrives");
    }

    #[test]
    fn a_subscriber_that_does_not_read_loses_messages_and_delays_nobody() {
        const MESSAGES: u32 = 3_000;
        let publisher = publisher();
        let [slow, quick] = [(); 2].map(|()| subscriber(&publisher, &[""]));
        for socket in [&slow, &quick] {
            before(&publisher, socket, "begin");
        }
        for number in 0..MESSAGES {
            let bytes = [&number.to_be_bytes()[..], &[0; 10_000]].concat();
            assert!(publisher.publish("data".to_owned(), bytes), "{number}");
            // What was sent for the other's begin comes first.
            let frames = loop {
                let frames = quick.recv_multipart(0).unwrap();
                if frames[0] == b"data" {
                    break frames;
                }
            };
            assert_eq!(frames[1][..4], number.to_be_bytes());
        }
        let heard = before(&publisher, &slow, "end");
        let heard = heard.iter().filter(|topic| *topic == "data").count();
        // 30 MB; the system holds some.
        assert!((1..MESSAGES as usize).contains(&heard), "{heard} messages");
    }
}
