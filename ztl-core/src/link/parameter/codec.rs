//! Encodes and decodes messages about parameters.

use super::{Domain, Kept, Parameter, ParameterCommand, ParameterMessage, Unfit, Value};
use crate::link::wire::{BodyError, Reader, WriteValues};
use crate::sink::Sink;

/// The tags of these messages.
pub(in crate::link) const FIRST: u32 = 22;
pub(in crate::link) const LAST: u32 = 26;

impl ParameterMessage<'_> {
    /// Writes the message.
    // Inlined in firmware, where each caller needs the encoder of one message only.
    #[cfg_attr(target_os = "none", inline(always))]
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Command(ParameterCommand::Read { index }) => {
                sink.byte(22).byte(index);
            }
            Self::Command(ParameterCommand::Set { index, value }) => {
                value.put(sink.byte(23).byte(index));
            }
            Self::Command(ParameterCommand::Save) => {
                sink.byte(24);
            }
            Self::Is(parameter) => put_parameter(&parameter, sink),
            Self::Saved => {
                sink.byte(26);
            }
        }
    }
}

fn put_parameter(parameter: &Parameter<'_>, sink: &mut (impl Sink + ?Sized)) {
    let sink = sink
        .byte(25)
        .byte(parameter.index)
        .byte(parameter.component);
    let sink = sink
        .bytes(parameter.name.as_bytes())
        .bytes(parameter.unit.as_bytes())
        .bytes(parameter.about.as_bytes())
        .byte(parameter.kept as u8);
    match parameter.domain {
        Domain::Bool => sink.byte(0),
        Domain::U32 { least, most } => sink.byte(1).number(least).number(most),
        Domain::I32 { least, most } => sink.byte(2).number(zigzag(least)).number(zigzag(most)),
        Domain::F32 { least, most } => {
            let sink = sink.byte(3);
            sink.put(&least.to_le_bytes());
            sink.put(&most.to_le_bytes());
            sink
        }
        Domain::Text { longest } => sink.byte(4).byte(longest),
    };
    parameter.default.put(sink);
    parameter.value.put(sink);
}

/// As postcard writes a signed number: those near zero are short.
const fn zigzag(number: i32) -> u32 {
    (number << 1 ^ number >> 31) as u32
}

const fn unzigzag(number: u32) -> i32 {
    (number >> 1) as i32 ^ -((number & 1) as i32)
}

impl<'a> Value<'a> {
    /// Writes the value.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Bool(on) => sink.byte(0).byte(on.into()),
            Self::U32(number) => sink.byte(1).number(number),
            Self::I32(number) => sink.byte(2).number(zigzag(number)),
            Self::F32(number) => {
                sink.byte(3).put(&number.to_le_bytes());
                sink
            }
            Self::Text(text) => sink.byte(4).bytes(text.as_bytes()),
        };
    }

    /// Parses a value that [`put`](Self::put) wrote.
    ///
    /// # Errors
    /// [`BodyError`] if the bytes are not exactly one value.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let value = reader.value();
        reader.finish(value)
    }
}

impl<'a> ParameterCommand<'a> {
    /// Parses a command.
    ///
    /// # Errors
    /// [`BodyError`] if the bytes are not exactly one command about parameters.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let command = reader.parameter_command(tag);
        reader.finish(command)
    }
}

impl<'a> Reader<'a> {
    /// Reads the message with this tag, one of [`FIRST`] to [`LAST`].
    pub(in crate::link) fn parameter_message(&mut self, tag: u32) -> ParameterMessage<'a> {
        match tag {
            25 => ParameterMessage::Is(self.parameter()),
            26 => ParameterMessage::Saved,
            tag => ParameterMessage::Command(self.parameter_command(tag)),
        }
    }

    fn parameter_command(&mut self, tag: u32) -> ParameterCommand<'a> {
        match tag {
            22 => ParameterCommand::Read { index: self.u8() },
            23 => ParameterCommand::Set {
                index: self.u8(),
                value: self.value(),
            },
            24 => ParameterCommand::Save,
            tag => self.fail(BodyError::UnknownTag { tag }, ParameterCommand::Save),
        }
    }

    fn parameter(&mut self) -> Parameter<'a> {
        let parameter = Parameter {
            index: self.u8(),
            component: self.u8(),
            name: self.text(),
            unit: self.text(),
            about: self.text(),
            kept: match self.u8() {
                0 => Kept::Never,
                1 => Kept::Saved,
                2 => Kept::Changed,
                3 => Kept::Replaced,
                _ => self.fail(BodyError::BadValue, Kept::Never),
            },
            domain: self.domain(),
            default: self.value(),
            value: self.value(),
        };
        // Firmware may give a value that it would not take from a gateway.
        let other = |value| parameter.domain.check(value) == Err(Unfit::Kind);
        if other(&parameter.default) || other(&parameter.value) {
            return self.fail(BodyError::BadValue, parameter);
        }
        parameter
    }

    fn domain(&mut self) -> Domain {
        match self.u8() {
            0 => Domain::Bool,
            1 => Domain::U32 {
                least: self.u32(),
                most: self.u32(),
            },
            2 => Domain::I32 {
                least: unzigzag(self.u32()),
                most: unzigzag(self.u32()),
            },
            3 => Domain::F32 {
                least: self.f32(),
                most: self.f32(),
            },
            4 => Domain::Text { longest: self.u8() },
            _ => self.fail(BodyError::BadValue, Domain::Bool),
        }
    }

    fn value(&mut self) -> Value<'a> {
        match self.u8() {
            0 => Value::Bool(match self.u8() {
                0 => false,
                1 => true,
                _ => self.fail(BodyError::BadValue, false),
            }),
            1 => Value::U32(self.u32()),
            2 => Value::I32(unzigzag(self.u32())),
            3 => Value::F32(self.f32()),
            4 => Value::Text(self.text()),
            _ => self.fail(BodyError::BadValue, Value::Bool(false)),
        }
    }
}
