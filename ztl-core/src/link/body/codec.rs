//! Messages as bytes.

use super::{Body, BodyError, Busy, GoalShape, Hello, IdList, Ids, LinkId, Loss, Offer, Welcome};
use crate::lifecycle::State;
use crate::sink::Sink;

impl<'a> Body<'a> {
    /// Reads a message.
    ///
    /// # Errors
    /// [`BodyError`] when it is none, or has anything after it.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let body = match tag {
            0..=5 => Self::from_gateway(tag, &mut reader),
            _ => Self::from_node(tag, &mut reader),
        };
        reader.finish(body)
    }

    /// Reads a message of a gateway: for a node, where the others would only take room.
    ///
    /// # Errors
    /// As [`parse`](Self::parse); a node's messages are not known.
    pub fn parse_command(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let body = Self::from_gateway(tag, &mut reader);
        reader.finish(body)
    }

    fn from_gateway(tag: u32, r: &mut Reader<'a>) -> Self {
        match tag {
            0 => Self::Hello(Hello {
                version: r.u8(),
                session: r.u32(),
                gateway: r.u64(),
            }),
            1 => Self::Describe { index: r.u8() },
            2 => Self::Start {
                task: r.task(),
                component: r.u8(),
                goal: r.text(),
                before_ms: r.u64(),
            },
            3 => Self::Abort { task: r.task() },
            5 => Self::Ack { task: r.task() },
            4 => Self::Ping,
            tag => r.fail(BodyError::UnknownTag { tag }, Self::Ping),
        }
    }

    fn from_node(tag: u32, r: &mut Reader<'a>) -> Self {
        match tag {
            6 => Self::Welcome(r.welcome()),
            7 => Self::Component {
                index: r.u8(),
                offer: r.offer(),
            },
            8 => Self::Started { task: r.task() },
            9 => Self::Refused { reason: r.text() },
            10 => Self::Aborting { task: r.task() },
            11 => Self::Pong {
                clock_ms: r.u64(),
                held: r.u8(),
            },
            12 => Self::Ended {
                task: r.task(),
                state: match State::from_code(i64::from(r.u8())) {
                    Some(state) if state.is_final() => state,
                    _ => r.fail(BodyError::BadValue, State::Failed),
                },
                result: r.text(),
            },
            13 => Self::Progress {
                task: r.task(),
                text: r.text(),
            },
            14 => Self::Publish {
                topic: r.u8(),
                bytes: r.bytes(),
            },
            15 => Self::Log {
                lost: r.u32(),
                bytes: r.bytes(),
            },
            16 => Self::Awake {
                version: r.u8(),
                boot: r.u32(),
            },
            tag => r.fail(BodyError::UnknownTag { tag }, Self::Ping),
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
            Self::Log { lost, bytes } => {
                sink.put(&[15]);
                put_varint(u64::from(lost), sink);
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
    match offer.busy {
        Busy::Refuse => sink.put(&[0]),
        Busy::Queue(most) => sink.put(&[1, most]),
        Busy::Replace => sink.put(&[2]),
    }
    sink.put(&[offer.loss as u8]);
    put_bytes(offer.topics.as_bytes(), sink);
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

/// Reads values one after the other. The first that is not there, or means nothing, ends it: all from
/// then on are zero or empty, and [`finish`](Self::finish) tells. So a value costs a call and no branch.
pub(super) struct Reader<'a> {
    rest: &'a [u8],
    error: Option<BodyError>,
}

impl<'a> Reader<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: bytes,
            error: None,
        }
    }

    fn finish<T>(self, value: T) -> Result<T, BodyError> {
        match (self.error, self.rest.len()) {
            (Some(error), _) => Err(error),
            (None, 0) => Ok(value),
            (None, extra) => Err(BodyError::Trailing { extra }),
        }
    }

    /// Whether all is read.
    pub(super) const fn is_at_end(&self) -> bool {
        self.rest.is_empty()
    }

    fn fail<T>(&mut self, error: BodyError, instead: T) -> T {
        self.end(error);
        instead
    }

    #[inline(never)]
    fn end(&mut self, error: BodyError) {
        self.error.get_or_insert(error);
        self.rest = &[];
    }

    #[inline(never)]
    fn u8(&mut self) -> u8 {
        match self.rest.split_first() {
            Some((first, rest)) => {
                self.rest = rest;
                *first
            }
            None => self.fail(BodyError::Truncated, 0),
        }
    }

    #[inline(never)]
    fn u64(&mut self) -> u64 {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8();
            // The tenth byte carries the last bit.
            if shift == 63 && byte > 1 {
                break;
            }
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return value;
            }
        }
        self.fail(BodyError::BadValue, 0)
    }

    #[inline(never)]
    fn u32(&mut self) -> u32 {
        match u32::try_from(self.u64()) {
            Ok(value) => value,
            Err(_) => self.fail(BodyError::BadValue, 0),
        }
    }

    fn u16(&mut self) -> u16 {
        match u16::try_from(self.u64()) {
            Ok(value) => value,
            Err(_) => self.fail(BodyError::BadValue, 0),
        }
    }

    fn f32(&mut self) -> f32 {
        f32::from_le_bytes([self.u8(), self.u8(), self.u8(), self.u8()])
    }

    #[inline(never)]
    fn bytes(&mut self) -> &'a [u8] {
        let len = usize::try_from(self.u32()).unwrap_or(usize::MAX);
        match self.rest.split_at_checked(len) {
            Some((bytes, rest)) => {
                self.rest = rest;
                bytes
            }
            None => self.fail(BodyError::Truncated, &[]),
        }
    }

    #[inline(never)]
    fn text(&mut self) -> &'a str {
        match core::str::from_utf8(self.bytes()) {
            Ok(text) => text,
            Err(_) => self.fail(BodyError::BadValue, ""),
        }
    }

    pub(super) fn task(&mut self) -> LinkId {
        LinkId(self.u32())
    }

    fn ids(&mut self) -> Ids<'a> {
        let count = usize::from(self.u16());
        let start = self.rest;
        for _ in 0..count {
            self.task();
            if self.error.is_some() {
                break;
            }
        }
        let used = start.len() - self.rest.len();
        let bytes = start.get(..used).unwrap_or_default();
        Ids(IdList::Encoded { count, bytes })
    }

    fn welcome(&mut self) -> Welcome<'a> {
        Welcome {
            version: self.u8(),
            name: self.text(),
            firmware: self.text(),
            boot: self.u32(),
            replaces: self.u32(),
            clock_ms: self.u64(),
            capacity: self.u8(),
            max_body: self.u16(),
            components: self.u8(),
            link_timeout_ms: self.u32(),
            highest: self.u32(),
            held: self.ids(),
        }
    }

    fn offer(&mut self) -> Offer<'a> {
        Offer {
            name: self.text(),
            goal: GoalShape {
                range: match self.u8() {
                    0 => None,
                    1 => Some((self.f32(), self.f32())),
                    _ => self.fail(BodyError::BadValue, None),
                },
                unit: self.text(),
                words: self.text(),
            },
            busy: match self.u8() {
                0 => Busy::Refuse,
                1 => Busy::Queue(self.u8()),
                2 => Busy::Replace,
                _ => self.fail(BodyError::BadValue, Busy::Refuse),
            },
            loss: match self.u8() {
                0 => Loss::Abort,
                1 => Loss::Hold,
                2 => Loss::CarryOn,
                _ => self.fail(BodyError::BadValue, Loss::Abort),
            },
            topics: self.text(),
        }
    }
}
