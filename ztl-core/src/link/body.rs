//! The messages of the link, in postcard's wire format: one enum for both directions, so that an
//! echo of one's own frame is no message for oneself.
//!
//! The format is postcard's (its derive is compared with this code in a test); it is written by hand
//! because it must work without serde, borrow its texts, and stay small on a node.

use crate::lifecycle::State;
use crate::sink::Sink;

/// The number of a task on one link. Rises with each `Start` that a node takes since its boot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkId(pub u32);

/// Opens a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Hello {
    /// [`VERSION`](super::VERSION) of the gateway.
    pub version: u8,
    /// The new session: random, never 0.
    pub session: u32,
    /// Who the gateway is, so that a restarted one is known again.
    pub gateway: u64,
}

/// Answers a `Hello`: who the node is, and what it still holds.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Welcome<'a> {
    /// [`VERSION`](super::VERSION) of the node.
    pub version: u8,
    /// What the firmware calls its device.
    pub name: &'a str,
    /// The firmware's version.
    pub firmware: &'a str,
    /// Random since the last reset; another one means that everything was forgotten.
    pub boot: u32,
    /// The session this one replaces, 0 after a reset.
    pub replaces: u32,
    /// The node's clock, milliseconds since its boot.
    pub clock_ms: u64,
    /// How many tasks it can hold, unacknowledged ends included.
    pub capacity: u8,
    /// Longest body it can take, in bytes.
    pub max_body: u16,
    /// How many components it has.
    pub components: u8,
    /// After how long without a new command it acts by itself.
    pub link_timeout_ms: u32,
    /// The highest id started since boot, 0 when none.
    pub highest: u32,
    /// The tasks it holds: running, or ended and not acknowledged.
    pub held: Ids<'a>,
}

/// What goals a component takes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GoalShape<'a> {
    /// Smallest and greatest number, when it takes numbers.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers; empty when it takes none.
    pub unit: &'a str,
    /// Words that it takes, separated by blanks; empty when none.
    pub words: &'a str,
}

/// What happens to a task that comes while one runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Busy {
    /// It is refused.
    Refuse = 0,
}

/// What a component does when the link has brought no new command for the link timeout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Loss {
    /// Stop, go to the safe state; the task ends as FAILED.
    Abort = 0,
    /// Keep the position under power; the task ends as FAILED.
    Hold = 1,
    /// Finish the task.
    CarryOn = 2,
}

/// What a node tells of one of its components.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Offer<'a> {
    /// Name, as a client writes it.
    pub name: &'a str,
    /// Goals that it takes.
    pub goal: GoalShape<'a>,
    /// What happens to a second task.
    pub busy: Busy,
    /// What happens when the link is lost.
    pub loss: Loss,
}

/// A message of the link.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// Gateway: opens a session.
    Hello(Hello),
    /// Gateway: asks for the component of this number.
    Describe {
        /// From 0.
        index: u8,
    },
    /// Gateway: starts a task.
    Start {
        /// Above every id started since the node's boot.
        task: LinkId,
        /// Number of the component.
        component: u8,
        /// The goal as the client wrote it.
        goal: &'a str,
        /// The node's clock, in milliseconds, after which it must refuse.
        before_ms: u64,
    },
    /// Gateway: stops a task.
    Abort {
        /// Which.
        task: LinkId,
    },
    /// Gateway: nothing new, only to be heard.
    Ping,
    /// Gateway: the end of this task is known, it need not be repeated.
    Ack {
        /// Which.
        task: LinkId,
    },
    /// Node: answers `Hello`.
    Welcome(Welcome<'a>),
    /// Node: answers `Describe`.
    Component {
        /// Its number.
        index: u8,
        /// What it is.
        offer: Offer<'a>,
    },
    /// Node: answers `Start`; the task runs.
    Started {
        /// Which.
        task: LinkId,
    },
    /// Node: answers any command that it does not follow.
    Refused {
        /// What was wrong, and what would be right.
        reason: &'a str,
    },
    /// Node: answers `Abort`; the end will be told.
    Aborting {
        /// Which.
        task: LinkId,
    },
    /// Node: answers `Ping`.
    Pong {
        /// Its clock in milliseconds.
        clock_ms: u64,
        /// How many tasks it holds.
        held: u8,
    },
    /// Node: a task has ended; repeated until acknowledged.
    Ended {
        /// Which.
        task: LinkId,
        /// A final state.
        state: State,
        /// What came of it.
        result: &'a str,
    },
    /// Node: where a task is; may be lost.
    Progress {
        /// Which.
        task: LinkId,
        /// The component's text.
        text: &'a str,
    },
    /// Node: a reading; may be lost.
    Publish {
        /// Its number.
        topic: u8,
        /// The reading.
        bytes: &'a [u8],
    },
    /// Node: part of its log; may be lost.
    Log {
        /// Encoded by defmt.
        bytes: &'a [u8],
    },
    /// Node: it has started and knows no session.
    Awake {
        /// [`VERSION`](super::VERSION) of the node.
        version: u8,
        /// Random since the last reset.
        boot: u32,
    },
}

/// Why bytes are no message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BodyError {
    /// They end too early.
    Truncated,
    /// There are this many too many.
    Trailing {
        /// Bytes after the message.
        extra: usize,
    },
    /// A message of this number is not known.
    UnknownTag {
        /// The number.
        tag: u32,
    },
    /// A value that has no meaning: a number too large, a state that is not final, text that is not UTF-8.
    BadValue,
}

impl core::fmt::Display for BodyError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Truncated => f.write_str("too short"),
            Self::Trailing { extra } => write!(f, "{extra} bytes too long"),
            Self::UnknownTag { tag } => write!(f, "unknown message {tag}"),
            Self::BadValue => f.write_str("meaningless value"),
        }
    }
}

impl core::error::Error for BodyError {}

/// A list of link ids: a slice to be sent, or a view over received bytes.
#[derive(Debug, Clone, Copy)]
pub struct Ids<'a>(IdList<'a>);

#[derive(Debug, Clone, Copy)]
enum IdList<'a> {
    Slice(&'a [LinkId]),
    /// Encoded ids, already checked.
    Encoded {
        count: usize,
        bytes: &'a [u8],
    },
}

impl<'a> Ids<'a> {
    /// The ids of a slice.
    #[must_use]
    pub const fn new(ids: &'a [LinkId]) -> Self {
        Self(IdList::Slice(ids))
    }

    /// How many.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self.0 {
            IdList::Slice(ids) => ids.len(),
            IdList::Encoded { count, .. } => count,
        }
    }

    /// Whether there are none.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Each of them.
    pub fn iter(&self) -> impl Iterator<Item = LinkId> + use<'a> {
        let (slice, bytes): (&'a [LinkId], &'a [u8]) = match self.0 {
            IdList::Slice(ids) => (ids, &[]),
            IdList::Encoded { bytes, .. } => (&[], bytes),
        };
        let mut reader = Reader(bytes);
        slice
            .iter()
            .copied()
            .chain(core::iter::from_fn(move || reader.task().ok()))
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for Ids<'_> {
    fn format(&self, f: defmt::Formatter<'_>) {
        for id in self.iter() {
            defmt::write!(f, "{} ", id);
        }
    }
}

impl PartialEq for Ids<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.iter().eq(other.iter())
    }
}

impl<'a> Body<'a> {
    /// Reads a message.
    ///
    /// # Errors
    /// [`BodyError`] when it is none, or has anything after it.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader(bytes);
        let r = &mut reader;
        let body = match r.u32()? {
            0 => Self::Hello(Hello {
                version: r.u8()?,
                session: r.u32()?,
                gateway: r.u64()?,
            }),
            1 => Self::Describe { index: r.u8()? },
            2 => Self::Start {
                task: r.task()?,
                component: r.u8()?,
                goal: r.text()?,
                before_ms: r.u64()?,
            },
            3 => Self::Abort { task: r.task()? },
            4 => Self::Ping,
            5 => Self::Ack { task: r.task()? },
            6 => Self::Welcome(r.welcome()?),
            7 => Self::Component {
                index: r.u8()?,
                offer: r.offer()?,
            },
            8 => Self::Started { task: r.task()? },
            9 => Self::Refused { reason: r.text()? },
            10 => Self::Aborting { task: r.task()? },
            11 => Self::Pong {
                clock_ms: r.u64()?,
                held: r.u8()?,
            },
            12 => Self::Ended {
                task: r.task()?,
                state: State::from_code(i64::from(r.u8()?))
                    .filter(|state| state.is_final())
                    .ok_or(BodyError::BadValue)?,
                result: r.text()?,
            },
            13 => Self::Progress {
                task: r.task()?,
                text: r.text()?,
            },
            14 => Self::Publish {
                topic: r.u8()?,
                bytes: r.bytes()?,
            },
            15 => Self::Log { bytes: r.bytes()? },
            16 => Self::Awake {
                version: r.u8()?,
                boot: r.u32()?,
            },
            tag => return Err(BodyError::UnknownTag { tag }),
        };
        match reader.0.len() {
            0 => Ok(body),
            extra => Err(BodyError::Trailing { extra }),
        }
    }

    /// Writes the message.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Hello(hello) => {
                sink.put(&[0, hello.version]);
                put_varint(u64::from(hello.session), sink);
                put_varint(hello.gateway, sink);
            }
            Self::Describe { index } => sink.put(&[1, index]),
            Self::Start {
                task,
                component,
                goal,
                before_ms,
            } => {
                put_tagged(2, task, sink);
                sink.put(&[component]);
                put_bytes(goal.as_bytes(), sink);
                put_varint(before_ms, sink);
            }
            Self::Abort { task } => put_tagged(3, task, sink),
            Self::Ping => sink.put(&[4]),
            Self::Ack { task } => put_tagged(5, task, sink),
            Self::Welcome(welcome) => put_welcome(&welcome, sink),
            Self::Component { index, offer } => {
                sink.put(&[7, index]);
                put_offer(&offer, sink);
            }
            Self::Started { task } => put_tagged(8, task, sink),
            Self::Refused { reason } => {
                sink.put(&[9]);
                put_bytes(reason.as_bytes(), sink);
            }
            Self::Aborting { task } => put_tagged(10, task, sink),
            Self::Pong { clock_ms, held } => {
                sink.put(&[11]);
                put_varint(clock_ms, sink);
                sink.put(&[held]);
            }
            Self::Ended {
                task,
                state,
                result,
            } => {
                put_tagged(12, task, sink);
                sink.put(&[state.code()]);
                put_bytes(result.as_bytes(), sink);
            }
            Self::Progress { task, text } => {
                put_tagged(13, task, sink);
                put_bytes(text.as_bytes(), sink);
            }
            Self::Publish { topic, bytes } => {
                sink.put(&[14, topic]);
                put_bytes(bytes, sink);
            }
            Self::Log { bytes } => {
                sink.put(&[15]);
                put_bytes(bytes, sink);
            }
            Self::Awake { version, boot } => {
                sink.put(&[16, version]);
                put_varint(u64::from(boot), sink);
            }
        }
    }
}

fn put_welcome(welcome: &Welcome<'_>, sink: &mut (impl Sink + ?Sized)) {
    sink.put(&[6, welcome.version]);
    put_bytes(welcome.name.as_bytes(), sink);
    put_bytes(welcome.firmware.as_bytes(), sink);
    put_varint(u64::from(welcome.boot), sink);
    put_varint(u64::from(welcome.replaces), sink);
    put_varint(welcome.clock_ms, sink);
    sink.put(&[welcome.capacity]);
    put_varint(u64::from(welcome.max_body), sink);
    sink.put(&[welcome.components]);
    put_varint(u64::from(welcome.link_timeout_ms), sink);
    put_varint(u64::from(welcome.highest), sink);
    put_varint(welcome.held.len() as u64, sink);
    for task in welcome.held.iter() {
        put_varint(u64::from(task.0), sink);
    }
}

fn put_offer(offer: &Offer<'_>, sink: &mut (impl Sink + ?Sized)) {
    put_bytes(offer.name.as_bytes(), sink);
    match offer.goal.range {
        None => sink.put(&[0]),
        Some((least, most)) => {
            sink.put(&[1]);
            sink.put(&least.to_le_bytes());
            sink.put(&most.to_le_bytes());
        }
    }
    put_bytes(offer.goal.unit.as_bytes(), sink);
    put_bytes(offer.goal.words.as_bytes(), sink);
    sink.put(&[offer.busy as u8, offer.loss as u8]);
}

fn put_tagged(tag: u8, task: LinkId, sink: &mut (impl Sink + ?Sized)) {
    sink.put(&[tag]);
    put_varint(u64::from(task.0), sink);
}

fn put_bytes(bytes: &[u8], sink: &mut (impl Sink + ?Sized)) {
    put_varint(bytes.len() as u64, sink);
    sink.put(bytes);
}

fn put_varint(mut value: u64, sink: &mut (impl Sink + ?Sized)) {
    while value >= 0x80 {
        sink.put(&[value as u8 | 0x80]);
        value >>= 7;
    }
    sink.put(&[value as u8]);
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn u8(&mut self) -> Result<u8, BodyError> {
        let (first, rest) = self.0.split_first().ok_or(BodyError::Truncated)?;
        self.0 = rest;
        Ok(*first)
    }

    fn u64(&mut self) -> Result<u64, BodyError> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8()?;
            // The tenth byte carries the last bit.
            if shift == 63 && byte > 1 {
                break;
            }
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(BodyError::BadValue)
    }

    fn u32(&mut self) -> Result<u32, BodyError> {
        u32::try_from(self.u64()?).map_err(|_| BodyError::BadValue)
    }

    fn u16(&mut self) -> Result<u16, BodyError> {
        u16::try_from(self.u64()?).map_err(|_| BodyError::BadValue)
    }

    fn f32(&mut self) -> Result<f32, BodyError> {
        let (bytes, rest) = self
            .0
            .split_first_chunk::<4>()
            .ok_or(BodyError::Truncated)?;
        self.0 = rest;
        Ok(f32::from_le_bytes(*bytes))
    }

    fn bytes(&mut self) -> Result<&'a [u8], BodyError> {
        let len = usize::try_from(self.u32()?).map_err(|_| BodyError::BadValue)?;
        let (bytes, rest) = self.0.split_at_checked(len).ok_or(BodyError::Truncated)?;
        self.0 = rest;
        Ok(bytes)
    }

    fn text(&mut self) -> Result<&'a str, BodyError> {
        core::str::from_utf8(self.bytes()?).map_err(|_| BodyError::BadValue)
    }

    fn task(&mut self) -> Result<LinkId, BodyError> {
        self.u32().map(LinkId)
    }

    fn ids(&mut self) -> Result<Ids<'a>, BodyError> {
        let count = usize::from(self.u16()?);
        let start = self.0;
        for _ in 0..count {
            self.task()?;
        }
        let used = start.len() - self.0.len();
        let bytes = start.get(..used).unwrap_or_default();
        Ok(Ids(IdList::Encoded { count, bytes }))
    }

    fn welcome(&mut self) -> Result<Welcome<'a>, BodyError> {
        Ok(Welcome {
            version: self.u8()?,
            name: self.text()?,
            firmware: self.text()?,
            boot: self.u32()?,
            replaces: self.u32()?,
            clock_ms: self.u64()?,
            capacity: self.u8()?,
            max_body: self.u16()?,
            components: self.u8()?,
            link_timeout_ms: self.u32()?,
            highest: self.u32()?,
            held: self.ids()?,
        })
    }

    fn offer(&mut self) -> Result<Offer<'a>, BodyError> {
        Ok(Offer {
            name: self.text()?,
            goal: GoalShape {
                range: match self.u8()? {
                    0 => None,
                    1 => Some((self.f32()?, self.f32()?)),
                    _ => return Err(BodyError::BadValue),
                },
                unit: self.text()?,
                words: self.text()?,
            },
            busy: match self.u8()? {
                0 => Busy::Refuse,
                _ => return Err(BodyError::BadValue),
            },
            loss: match self.u8()? {
                0 => Loss::Abort,
                1 => Loss::Hold,
                2 => Loss::CarryOn,
                _ => return Err(BodyError::BadValue),
            },
        })
    }
}

#[cfg(test)]
mod tests;
