//! Encodes and decodes messages about updates.

use super::{Firmware, SelfTest, UpdateCommand, UpdateError, UpdateMessage, UpdatePhase};
use crate::link::wire::{BodyError, Reader, WriteValues};
use crate::sink::Sink;

/// The tags of these messages.
pub(in crate::link) const FIRST: u32 = 27;
pub(in crate::link) const LAST: u32 = 32;

/// Bits of the flags in `BeginUpdate`.
const NOW: u8 = 1;
const DOWNGRADE: u8 = 2;

impl UpdateMessage<'_> {
    /// Writes the message.
    // Inlined in firmware, where each caller needs the encoder of one message only.
    #[cfg_attr(target_os = "none", inline(always))]
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Command(command) => put_command(&command, sink),
            Self::Firmware(firmware) => {
                let sink = sink
                    .byte(31)
                    .bytes(firmware.board.as_bytes())
                    .bytes(firmware.version.as_bytes())
                    .byte(firmware.confirmed.into())
                    .number(firmware.trial_ms);
                match firmware.self_test {
                    None => sink.byte(0),
                    Some(test) => sink
                        .byte(1)
                        .byte(test.component)
                        .bytes(test.goal.as_bytes()),
                };
            }
            Self::Phase(phase) => {
                let sink = sink.byte(32);
                match phase {
                    UpdatePhase::Idle => sink.byte(0),
                    UpdatePhase::Stopping => sink.byte(1),
                    UpdatePhase::Receiving { offset } => sink.byte(2).number(offset),
                    UpdatePhase::Verifying => sink.byte(3),
                    UpdatePhase::Ready => sink.byte(4),
                    UpdatePhase::Restarting => sink.byte(5),
                    UpdatePhase::Failed(error) => sink.byte(6).byte(error.code()),
                };
            }
        }
    }
}

fn put_command(command: &UpdateCommand<'_>, sink: &mut (impl Sink + ?Sized)) {
    match *command {
        UpdateCommand::Read => sink.byte(27),
        UpdateCommand::Begin {
            now,
            downgrade,
            manifest,
        } => {
            let flags = u8::from(now) * NOW + u8::from(downgrade) * DOWNGRADE;
            sink.byte(28).byte(flags).bytes(manifest)
        }
        UpdateCommand::Write { offset, bytes } => sink.byte(29).number(offset).bytes(bytes),
        UpdateCommand::Ask => sink.byte(30).byte(0),
        UpdateCommand::Finish => sink.byte(30).byte(1),
        UpdateCommand::Restart => sink.byte(30).byte(2),
        UpdateCommand::Confirm => sink.byte(30).byte(3),
        UpdateCommand::Cancel => sink.byte(30).byte(4),
    };
}

impl<'a> UpdateCommand<'a> {
    /// Parses a command.
    ///
    /// # Errors
    /// [`BodyError`] if the bytes are not exactly one command about updates.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let tag = reader.u32();
        let command = reader.update_command(tag);
        reader.finish(command)
    }
}

impl<'a> Reader<'a> {
    /// Reads the message with this tag, one of [`FIRST`] to [`LAST`].
    pub(in crate::link) fn update_message(&mut self, tag: u32) -> UpdateMessage<'a> {
        match tag {
            31 => UpdateMessage::Firmware(Firmware {
                board: self.text(),
                version: self.text(),
                confirmed: self.bool(),
                trial_ms: self.u32(),
                self_test: self.bool().then(|| SelfTest {
                    component: self.u8(),
                    goal: self.text(),
                }),
            }),
            32 => UpdateMessage::Phase(match self.u8() {
                0 => UpdatePhase::Idle,
                1 => UpdatePhase::Stopping,
                2 => UpdatePhase::Receiving { offset: self.u32() },
                3 => UpdatePhase::Verifying,
                4 => UpdatePhase::Ready,
                5 => UpdatePhase::Restarting,
                6 => UpdatePhase::Failed(UpdateError::from_code(self.u8())),
                _ => self.fail(BodyError::BadValue, UpdatePhase::Idle),
            }),
            tag => UpdateMessage::Command(self.update_command(tag)),
        }
    }

    fn update_command(&mut self, tag: u32) -> UpdateCommand<'a> {
        match tag {
            27 => UpdateCommand::Read,
            28 => {
                let flags = self.u8();
                let begin = UpdateCommand::Begin {
                    now: flags & NOW != 0,
                    downgrade: flags & DOWNGRADE != 0,
                    manifest: self.bytes(),
                };
                match flags <= NOW | DOWNGRADE {
                    true => begin,
                    false => self.fail(BodyError::BadValue, begin),
                }
            }
            29 => UpdateCommand::Write {
                offset: self.u32(),
                bytes: self.bytes(),
            },
            30 => match self.u8() {
                0 => UpdateCommand::Ask,
                1 => UpdateCommand::Finish,
                2 => UpdateCommand::Restart,
                3 => UpdateCommand::Confirm,
                4 => UpdateCommand::Cancel,
                _ => self.fail(BodyError::BadValue, UpdateCommand::Ask),
            },
            tag => self.fail(BodyError::UnknownTag { tag }, UpdateCommand::Ask),
        }
    }

    fn bool(&mut self) -> bool {
        match self.u8() {
            0 => false,
            1 => true,
            _ => self.fail(BodyError::BadValue, false),
        }
    }
}
