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
            15 => Self::Log {
                lost: r.u32()?,
                bytes: r.bytes()?,
            },
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

pub(super) struct Reader<'a>(pub(super) &'a [u8]);

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

    pub(super) fn task(&mut self) -> Result<LinkId, BodyError> {
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
                1 => Busy::Queue(self.u8()?),
                2 => Busy::Replace,
                _ => return Err(BodyError::BadValue),
            },
            loss: match self.u8()? {
                0 => Loss::Abort,
                1 => Loss::Hold,
                2 => Loss::CarryOn,
                _ => return Err(BodyError::BadValue),
            },
            topics: self.text()?,
        })
    }
}
