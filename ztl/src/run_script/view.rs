//! The view of a run: the live view, or the original's lines and single keys.

use std::io;
use std::time::Duration;
#[cfg(unix)]
use std::time::SystemTime;

use tracing::{error, warn};
#[cfg(unix)]
use ztl_script::event::RunEvent;
use ztl_script::event::StampedEvent;
use ztl_script::{RunnerHandle, Script};

use super::output::LineOutput;
use super::plain::{LOG, PlainView};
use crate::key_press::{KeyPress, first_key};
use crate::keyboard::Keyboard;
#[cfg(unix)]
use crate::{live::LiveView, terminal, terminal_mode};

/// Whether the terminal can show the live view.
pub(super) fn can_be_live() -> bool {
    #[cfg(unix)]
    return terminal::can_show_screen();
    #[cfg(not(unix))]
    false
}

/// Restores the terminal.
pub(super) fn restore() {
    #[cfg(unix)]
    terminal_mode::restore();
}

pub(super) enum View<'s> {
    #[cfg(unix)]
    Live(LiveView),
    Plain(Box<PlainView<'s>>, Option<Keyboard>),
}

impl<'s> View<'s> {
    /// Opens the live view, or with `lines` the plain one. `unattended`: the plain view takes no keys.
    ///
    /// # Errors
    /// If there is no terminal to read keys from.
    pub(super) fn open(
        script: &'s Script,
        inputs: RunnerHandle,
        lines: Option<LineOutput>,
        unattended: bool,
    ) -> Result<Self, Box<dyn std::error::Error>> {
        let Some(lines) = lines else {
            #[cfg(unix)]
            return Ok(Self::Live(LiveView::open(
                move || inputs.wake(),
                !unattended,
            )?));
            #[cfg(not(unix))]
            return Err("the live view is not supported on this system; use --plain".into());
        };
        let keyboard = match unattended {
            true => None,
            false => {
                let inputs = inputs.clone();
                Some(Keyboard::open(move || inputs.wake()).map_err(no_keyboard)?)
            }
        };
        let plain = PlainView::new(script, lines, inputs);
        Ok(Self::Plain(Box::new(plain), keyboard))
    }

    /// The next key press, if there is one.
    pub(super) fn pressed(&self) -> Option<KeyPress> {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.pressed(),
            Self::Plain(plain, _) if plain.is_asking() => None,
            Self::Plain(plain, keyboard) => {
                let key = keyboard.as_ref()?.next()?;
                Some(KeyPress {
                    command: plain.meaning(&key),
                    cue: None,
                    question: plain.question(),
                    // An incomplete sequence is a lone ESC.
                    key: first_key(&key.bytes).map_or("Esc".to_owned(), |(name, _)| name),
                })
            }
        }
    }

    /// Shows an event.
    pub(super) fn handle(&mut self, event: &StampedEvent) {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.handle(event),
            Self::Plain(plain, keyboard) => plain.handle(&event.event, keyboard.as_ref()),
        }
    }

    /// Shows a warning that is not part of the run.
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

    /// Restores the terminal after the run.
    pub(super) fn close(self) {
        match self {
            #[cfg(unix)]
            Self::Live(live) => live.close(),
            Self::Plain(..) => {}
        }
    }
}

fn no_keyboard(error: io::Error) -> String {
    // The original's words, which scripts look for.
    let (code, text) = (
        error.raw_os_error().unwrap_or_default(),
        "Inappropriate ioctl for device",
    );
    error!(target: LOG, "({code}, '{text}')");
    "stdin is not a terminal, so the operator cannot be asked; use --yes to play without asking"
        .to_owned()
}
