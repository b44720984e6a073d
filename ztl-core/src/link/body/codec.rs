//! Messages as bytes.

use super::{
    Body, BodyError, Busy, Command, GoalShape, Hello, IdList, Ids, LinkId, Loss, Offer, Welcome,
};
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

    fn from_gateway(tag: u32, r: &mut Reader<'a>) -> Self {
        match r.command(tag) {
            Command::Hello(hello) => Self::Hello(hello),
            Command::Describe { index } => Self::Describe { index },
            Command::Start {
                task,
                component,
                goal,
                before_ms,
            } => Self::Start {
                task,
                component,
                goal: r.valid(goal),
                before_ms,
            },
            Command::Abort { task } => Self::Abort { task },
            Command::Ping => Self::Ping,
            Command::Ack { task } => Self::Ack { task },
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
    // In firmware each message is written where it is made, so that nothing is left of the others.
    #[cfg_attr(target_os = "none", inline(always))]
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Hello(hello) => {
                let opened = sink.byte(0).byte(hello.version).number(hello.session);
                opened.long(hello.gateway);
            }
            Self::Describe { index } => {
                sink.byte(1).byte(index);
            }
            Self::Start {
                task,
                component,
                goal,
                before_ms,
            } => {
                let started = sink.tagged(2, task).byte(component);
                started.bytes(goal.as_bytes()).long(before_ms);
            }
            Self::Abort { task } => {
                sink.tagged(3, task);
            }
            Self::Ping => {
                sink.byte(4);
            }
            Self::Ack { task } => {
                sink.tagged(5, task);
            }
            Self::Welcome(welcome) => put_welcome(&welcome, sink),
            Self::Component { index, offer } => put_offer(index, &offer, sink),
            Self::Started { task } => {
                sink.tagged(8, task);
            }
            Self::Refused { reason } => {
                sink.byte(9).bytes(reason.as_bytes());
            }
            Self::Aborting { task } => {
                sink.tagged(10, task);
            }
            Self::Pong { clock_ms, held } => {
                sink.byte(11).long(clock_ms).byte(held);
            }
            Self::Ended {
                task,
                state,
                result,
            } => {
                let ended = sink.tagged(12, task).byte(state.code());
                ended.bytes(result.as_bytes());
            }
            Self::Progress { task, text } => {
                sink.tagged(13, task).bytes(text.as_bytes());
            }
            Self::Publish { topic, bytes } => {
                Self::put_publish(topic, bytes.len(), sink);
                sink.put(bytes);
            }
            Self::Log { lost, bytes } => {
                Self::put_log(lost, bytes.len(), sink);
                sink.put(bytes);
            }
            Self::Awake { version, boot } => {
                sink.byte(16).byte(version).number(boot);
            }
        }
    }
}

impl<'a> Command<'a> {
    /// Reads a message of a gateway.
    ///
    /// # Errors
    /// As [`Body::parse`]; a node's messages are not known.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let command = reader.command(tag);
        reader.finish(command)
    }
}

/// For who has the bytes already where they are sent from.
impl Body<'_> {
    /// Writes the beginning of a [`Publish`](Self::Publish) of so many bytes, which have to follow.
    pub fn put_publish(topic: u8, count: usize, sink: &mut (impl Sink + ?Sized)) {
        sink.byte(14).byte(topic).number(count as u32);
    }

    /// Writes the beginning of a [`Log`](Self::Log) of so many bytes, which have to follow.
    pub fn put_log(lost: u32, count: usize, sink: &mut (impl Sink + ?Sized)) {
        sink.byte(15).number(lost).number(count as u32);
    }
}

fn put_welcome(welcome: &Welcome<'_>, sink: &mut (impl Sink + ?Sized)) {
    let sink = sink
        .byte(6)
        .byte(welcome.version)
        .bytes(welcome.name.as_bytes())
        .bytes(welcome.firmware.as_bytes())
        .number(welcome.boot)
        .number(welcome.replaces)
        .long(welcome.clock_ms)
        .byte(welcome.capacity)
        .number(welcome.max_body.into())
        .byte(welcome.components)
        .number(welcome.link_timeout_ms)
        .number(welcome.highest)
        .number(welcome.held.len() as u32);
    match welcome.held.0 {
        IdList::Slice(ids) => {
            for task in ids {
                sink.number(task.0);
            }
        }
        IdList::Encoded { bytes, .. } => sink.put(bytes),
    }
}

fn put_offer(index: u8, offer: &Offer<'_>, sink: &mut (impl Sink + ?Sized)) {
    let sink = sink.byte(7).byte(index).bytes(offer.name.as_bytes());
    let sink = match offer.goal.range {
        None => sink.byte(0),
        Some((least, most)) => {
            let sink = sink.byte(1);
            for bound in [least, most] {
                sink.put(&bound.to_le_bytes());
            }
            sink
        }
    };
    let sink = sink
        .bytes(offer.goal.unit.as_bytes())
        .bytes(offer.goal.words.as_bytes());
    let sink = match offer.busy {
        Busy::Refuse => sink.byte(0),
        Busy::Queue(most) => sink.byte(1).byte(most),
        Busy::Replace => sink.byte(2),
    };
    sink.byte(offer.loss as u8).bytes(offer.topics.as_bytes());
}

/// Writes values one after the other.
///
/// Each gives the sink on: a Cortex-M0 then has it in its register for the next call.
trait Values: Sink {
    fn byte(&mut self, byte: u8) -> &mut Self;

    fn long(&mut self, number: u64) -> &mut Self;

    fn number(&mut self, number: u32) -> &mut Self;

    fn bytes(&mut self, bytes: &[u8]) -> &mut Self;

    fn tagged(&mut self, tag: u8, task: LinkId) -> &mut Self;
}

impl<S: Sink + ?Sized> Values for S {
    #[cfg_attr(target_os = "none", inline(never))]
    fn byte(&mut self, byte: u8) -> &mut Self {
        self.put(&[byte]);
        self
    }

    #[cfg_attr(target_os = "none", inline(never))]
    fn long(&mut self, number: u64) -> &mut Self {
        // By halves, since a Cortex-M0 shifts 64 bits by a call.
        let (mut low, mut high) = (number as u32, (number >> 32) as u32);
        while high > 0 || low >= 0x80 {
            self.byte(low as u8 | 0x80);
            low = low >> 7 | high << 25;
            high >>= 7;
        }
        self.byte(low as u8)
    }

    #[cfg_attr(target_os = "none", inline(never))]
    fn number(&mut self, number: u32) -> &mut Self {
        self.long(number.into())
    }

    #[cfg_attr(target_os = "none", inline(never))]
    fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.number(bytes.len() as u32).put(bytes);
        self
    }

    #[cfg_attr(target_os = "none", inline(never))]
    fn tagged(&mut self, tag: u8, task: LinkId) -> &mut Self {
        self.byte(tag).number(task.0)
    }
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
        let end = self.rest.iter().position(|byte| *byte < 0x80);
        let number = end.and_then(|end| self.rest.split_at_checked(end + 1));
        let Some((bytes, rest)) = number else {
            return self.fail(BodyError::Truncated, 0);
        };
        // The tenth byte carries the last bit.
        if bytes.len() > 10 || bytes.get(9).is_some_and(|tenth| *tenth > 1) {
            return self.fail(BodyError::BadValue, 0);
        }
        self.rest = rest;
        // By halves, since a Cortex-M0 shifts 64 bits by a call.
        let (mut low, mut high) = (0u32, 0u32);
        for byte in bytes.iter().rev() {
            high = high << 7 | low >> 25;
            low = low << 7 | u32::from(byte & 0x7f);
        }
        u64::from(high) << 32 | u64::from(low)
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

    fn text(&mut self) -> &'a str {
        let bytes = self.bytes();
        self.valid(bytes)
    }

    #[inline(never)]
    fn valid(&mut self, bytes: &'a [u8]) -> &'a str {
        match core::str::from_utf8(bytes) {
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

    fn command(&mut self, tag: u32) -> Command<'a> {
        match tag {
            0 => Command::Hello(Hello {
                version: self.u8(),
                session: self.u32(),
                gateway: self.u64(),
            }),
            1 => Command::Describe { index: self.u8() },
            2 => Command::Start {
                task: self.task(),
                component: self.u8(),
                goal: self.bytes(),
                before_ms: self.u64(),
            },
            3 => Command::Abort { task: self.task() },
            4 => Command::Ping,
            5 => Command::Ack { task: self.task() },
            tag => self.fail(BodyError::UnknownTag { tag }, Command::Ping),
        }
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
