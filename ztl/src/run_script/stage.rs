//! Where a show is seen and its operator heard: the live view, or lines and single keys.

use std::time::Duration;
#[cfg(unix)]
use std::time::SystemTime;

use tracing::warn;
#[cfg(unix)]
use ztl_script::event::RunEvent;
use ztl_script::event::StampedEvent;
use ztl_script::{RunnerHandle, Script};

use super::lines::Lines;
use super::plain::Plain;
use super::{LOG, no_keyboard};
use crate::key_name::{self, Pressed};
use crate::keyboard::Keyboard;
#[cfg(unix)]
use crate::live::{self, Live};

/// Whether there is a terminal for the live view.
pub(super) fn can_be_live() -> bool {
    #[cfg(unix)]
    return live::tty::is_there();
    #[cfg(not(unix))]
    false
}

/// Gives the terminal back, whatever has it.
pub(super) fn restore() {
    Keyboard::restore();
    #[cfg(unix)]
    live::tty::restore();
}

pub(super) enum Stage<'s> {
    #[cfg(unix)]
    Live(Live),
    Plain(Box<Plain<'s>>, Option<Keyboard>),
}

impl<'s> Stage<'s> {
    /// Takes the terminal for the live view, or the keyboard when there are `lines`; `unattended`: nobody
    /// presses keys on lines.
    ///
    /// # Errors
    /// When there is no terminal to read keys from.
    pub(super) fn open(
        script: &'s Script,
        inputs: RunnerHandle,
        lines: Option<Lines>,
        unattended: bool,
    ) -> Result<Self, Box<dyn std::error::Error>> {
        let Some(lines) = lines else {
            #[cfg(unix)]
            return Ok(Self::Live(Live::open(move || inputs.wake())?));
            #[cfg(not(unix))]
            return Err("there is no live view here; use --plain".into());
        };
        let keyboard = match unattended {
            true => None,
            false => {
                let inputs = inputs.clone();
                Some(Keyboard::open(move || inputs.wake()).map_err(no_keyboard)?)
            }
        };
        let plain = Plain::new(script, lines, inputs);
        Ok(Self::Plain(Box::new(plain), keyboard))
    }

    /// The next key that was pressed, if any was.
    pub(super) fn pressed(&self) -> Option<Pressed> {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.pressed(),
            Self::Plain(plain, _) if plain.is_asking() => None,
            Self::Plain(plain, keyboard) => {
                let key = keyboard.as_ref()?.next()?;
                Some(Pressed {
                    command: plain.meaning(&key),
                    question: plain.question(),
                    // A lone ESC has nothing after it.
                    key: key_name::first(&key.bytes).map_or("Esc".to_owned(), |(name, _)| name),
                })
            }
        }
    }

    /// Something has happened.
    pub(super) fn tell(&mut self, event: &StampedEvent) {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.handle(event),
            Self::Plain(plain, keyboard) => plain.tell(&event.event, keyboard.as_ref()),
        }
    }

    /// Something that is no part of the run.
    pub(super) fn warn(&mut self, at: Duration, text: &str) {
        #[cfg(not(unix))]
        let _ = at;
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.handle(&StampedEvent {
                at,
                wall: SystemTime::now(),
                event: RunEvent::Note {
                    text: text.to_owned(),
                },
            }),
            Self::Plain(..) => warn!(target: LOG, "{text}"),
        }
    }

    /// The show is over: the terminal is as it was before.
    pub(super) fn close(self) {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.close(),
            Self::Plain(..) => {}
        }
    }
}
