//! Encodes and decodes messages.

use super::body::{Body, Busy, GoalShape, Hello, LinkCommand, Loss, Offer, OwnAnswer, Welcome};
use super::ids::{IdList, Ids};
use super::link_id::LinkId;
use super::parameter;
use super::update;
use super::wire::{BodyError, Reader, WriteValues};
use crate::lifecycle::State;
use crate::sink::Sink;

impl<'a> Body<'a> {
    /// Parses a message.
    ///
    /// # Errors
    /// [`BodyError`] if the bytes are not exactly one message.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let body = match tag {
            0..=5 => Self::from_gateway(tag, &mut reader),
            parameter::FIRST..=parameter::LAST => Self::Parameter(reader.parameter_message(tag)),
            update::FIRST..=update::LAST => Self::Update(reader.update_message(tag)),
            _ => Self::from_node(tag, &mut reader),
        };
        reader.finish(body)
    }

    fn from_gateway(tag: u32, r: &mut Reader<'a>) -> Self {
        match r.command(tag) {
            LinkCommand::Hello(hello) => Self::Hello(hello),
            LinkCommand::Describe { index } => Self::Describe { index },
            LinkCommand::Start {
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
            LinkCommand::Abort { task } => Self::Abort { task },
            LinkCommand::Ping => Self::Ping,
            LinkCommand::Ack { task } => Self::Ack { task },
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
            17 => Self::Description {
                index: r.u8(),
                component: r.u8(),
                bytes: r.bytes(),
            },
            18 => Self::Begun {
                task: r.task(),
                component: r.u8(),
                goal: r.text(),
            },
            19 => Self::Noted { task: r.task() },
            20 => Self::Event {
                number: r.u32(),
                text: r.text(),
            },
            21 => Self::EventAck { number: r.u32() },
            tag => r.fail(BodyError::UnknownTag { tag }, Self::Ping),
        }
    }

    /// Writes the message.
    // Inlined in firmware, where each caller needs the encoder of one message only.
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
            Self::Description {
                index,
                component,
                bytes,
            } => {
                sink.byte(17).byte(index).byte(component).bytes(bytes);
            }
            Self::Begun {
                task,
                component,
                goal,
            } => {
                let begun = sink.tagged(18, task).byte(component);
                begun.bytes(goal.as_bytes());
            }
            Self::Noted { task } => {
                sink.tagged(19, task);
            }
            Self::Event { number, text } => {
                sink.byte(20).number(number).bytes(text.as_bytes());
            }
            Self::EventAck { number } => {
                sink.byte(21).number(number);
            }
            Self::Parameter(message) => message.put(sink),
            Self::Update(message) => message.put(sink),
        }
    }
}

impl<'a> LinkCommand<'a> {
    /// Parses a message of a gateway.
    ///
    /// # Errors
    /// Like [`Body::parse`]; the messages of a node are unknown.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let command = reader.command(tag);
        reader.finish(command)
    }
}

impl OwnAnswer {
    /// Parses a message of a gateway about tasks and events of a node itself.
    ///
    /// # Errors
    /// Like [`Body::parse`]; all other messages are unknown.
    pub fn parse(bytes: &[u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let answer = match reader.u32() {
            19 => Self::Noted {
                task: reader.task(),
            },
            21 => Self::EventAck {
                number: reader.u32(),
            },
            tag => reader.fail(BodyError::UnknownTag { tag }, Self::EventAck { number: 0 }),
        };
        reader.finish(answer)
    }
}

/// Headers, for callers whose bytes are in the buffer already.
impl Body<'_> {
    /// Writes the header of a [`Publish`](Self::Publish) with this many bytes, which must follow.
    pub fn put_publish(topic: u8, count: usize, sink: &mut (impl Sink + ?Sized)) {
        sink.byte(14).byte(topic).number(count as u32);
    }

    /// Writes the header of an [`Ended`](Self::Ended) with a result of this many bytes, which must follow.
    pub fn put_ended(task: LinkId, state: State, count: usize, sink: &mut (impl Sink + ?Sized)) {
        let ended = sink.tagged(12, task).byte(state.code());
        ended.number(count as u32);
    }

    /// Writes the header of a [`Log`](Self::Log) with this many bytes, which must follow.
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

impl<'a> Reader<'a> {
    fn ids(&mut self) -> Ids<'a> {
        let count = usize::from(self.u16());
        let bytes = self.numbers(count);
        Ids(IdList::Encoded { count, bytes })
    }

    fn command(&mut self, tag: u32) -> LinkCommand<'a> {
        match tag {
            0 => LinkCommand::Hello(Hello {
                version: self.u8(),
                session: self.u32(),
                gateway: self.u64(),
            }),
            1 => LinkCommand::Describe { index: self.u8() },
            2 => LinkCommand::Start {
                task: self.task(),
                component: self.u8(),
                goal: self.bytes(),
                before_ms: self.u64(),
            },
            3 => LinkCommand::Abort { task: self.task() },
            4 => LinkCommand::Ping,
            5 => LinkCommand::Ack { task: self.task() },
            tag => self.fail(BodyError::UnknownTag { tag }, LinkCommand::Ping),
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
