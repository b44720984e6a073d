//! The buttons of a simulated device: what its firmware does without a gateway.

use std::sync::mpsc::{Sender, channel};

use ztl_mcu::link::LinkId;
use ztl_mcu::{Components, Instant, Node};

use super::input::{Input, Push};

/// The buttons of a running device.
#[derive(Debug, Clone)]
pub struct Buttons(pub(super) Sender<Input>);

impl Buttons {
    /// Starts a task with this goal, as a jog button does while it is pressed.
    ///
    /// # Errors
    /// Why the device starts none.
    pub fn press(&self, goal: &str) -> Result<(), String> {
        self.push(Push::Press(goal.to_owned()))
    }

    /// Aborts the task of the last press.
    ///
    /// # Errors
    /// If the task that was started here has ended.
    pub fn release(&self) -> Result<(), String> {
        self.push(Push::Release)
    }

    /// Makes the firmware report an event.
    ///
    /// # Errors
    /// If too many events wait.
    pub fn report(&self, event: &str) -> Result<(), String> {
        self.push(Push::Report(event.to_owned()))
    }

    fn push(&self, push: Push) -> Result<(), String> {
        let (done, answer) = channel();
        let _ = self.0.send(Input::Push(push, done));
        answer
            .recv()
            .unwrap_or_else(|_| Err("the device is switched off".to_owned()))
    }
}

/// What the firmware does when a button is pushed; `pressed` is the task of the last press.
pub(super) fn on_push<C: Components, const TASKS: usize, const FRAME: usize>(
    node: &mut Node<'_, C, TASKS, FRAME>,
    now: Instant,
    pressed: &mut Option<LinkId>,
    push: &Push,
) -> Result<(), String> {
    match push {
        Push::Press(goal) => {
            let started = node.start_here(now, 0, goal);
            *pressed = Some(started.map_err(|reason| reason.as_str().to_owned())?);
            Ok(())
        }
        Push::Release => match pressed.take() {
            Some(task) if node.abort_here(now, task) => Ok(()),
            _ => Err("no task was started here, or it has ended".to_owned()),
        },
        Push::Report(event) => match node.report_event(now, event) {
            true => Ok(()),
            false => Err("too many events wait for a gateway".to_owned()),
        },
    }
}
