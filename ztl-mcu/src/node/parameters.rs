//! Reads, sets and saves parameters for the gateway.

use ztl_core::Instant;
use ztl_core::link::parameter::{
    NO_COMPONENT, Parameter, ParameterCommand, ParameterMessage, Unfit, Value,
};
use ztl_core::link::{FrameWriter, NO_SEQ};

use super::link_state::{Answer, Counters, LinkState, Other, count};
use super::refusal::Refusal;
use super::runner::TaskRunner;
use crate::component::{Components, Report};
use crate::parameters::SaveError;

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    /// Handles a command of the current session.
    pub(super) fn on_parameter_command(
        &mut self,
        now: Instant,
        (addr, seq, command): (u8, u8, ParameterCommand<'_>),
        counters: &mut Counters,
    ) {
        count(&mut counters.frames);
        if addr == self.address() && seq != NO_SEQ {
            self.in_sequence(now, seq, counters, |state, _| {
                // Like for any other command.
                state.check_link_timer(now);
                Some(state.runner.execute(command))
            });
        }
    }
}

impl<C: Components, const TASKS: usize> TaskRunner<C, TASKS> {
    fn execute(&mut self, command: ParameterCommand<'_>) -> Answer {
        let (answer, done) = match command {
            ParameterCommand::Read { index } => {
                (Answer::Parameter(index), self.parameter(index).map(drop))
            }
            ParameterCommand::Set { index, value } => {
                (Answer::Parameter(index), self.set_parameter(index, value))
            }
            ParameterCommand::Save => (Answer::Other(Other::Saved), self.save_parameters()),
        };
        match done {
            Ok(()) => answer,
            Err(reason) => {
                Report::new(&mut self.reason).text(reason);
                Answer::Refused(Refusal::ByComponent)
            }
        }
    }

    fn parameter(&self, index: u8) -> Result<Parameter<'_>, &'static str> {
        let tuning = self.components.tuning();
        let parameter = tuning.and_then(|tuning| tuning.parameter(index));
        parameter.ok_or("no such parameter")
    }

    /// Whether a component carries out a task, or is on its way to the safe state; or any component, for
    /// [`NO_COMPONENT`].
    pub(super) fn moves(&self, component: u8) -> bool {
        let concerned = |index: usize| component == NO_COMPONENT || index == usize::from(component);
        let mut open = self.tasks.0.iter().filter(|task| task.is_open());
        if open.any(|task| concerned(usize::from(task.component))) {
            return true;
        }
        let mut to_safety =
            (0..self.components.count()).filter(|index| self.unsafe_components.has(*index));
        to_safety.any(concerned)
    }

    fn set_parameter(&mut self, index: u8, value: Value<'_>) -> Result<(), &'static str> {
        let component = self.parameter(index)?.component;
        if self.moves(component) {
            return Err("a task runs that it would change");
        }
        let set = self
            .components_mut()
            .tuning_mut()
            .map(|tuning| tuning.set(index, value));
        match set {
            Some(Err(Unfit::Kind)) => Err("the value is of another kind"),
            Some(Err(Unfit::Range)) => Err("the value is out of its range"),
            _ => Ok(()),
        }
    }

    /// Writing to flash may stop the processor for a while, so nothing may move.
    fn save_parameters(&mut self) -> Result<(), &'static str> {
        if self.moves(NO_COMPONENT) {
            return Err("not while a component moves or is not safe");
        }
        match self.components.tuning_mut().map(|tuning| tuning.save()) {
            Some(Ok(())) => Ok(()),
            Some(Err(SaveError::Failed)) => Err("the storage is full or broken"),
            Some(Err(SaveError::NoStorage)) | None => Err("this firmware saves no parameters"),
        }
    }

    /// Encodes the answer to a command about this parameter.
    pub(super) fn put_parameter(&self, index: u8, frame: &mut FrameWriter<'_>) {
        if let Ok(parameter) = self.parameter(index) {
            ParameterMessage::Is(parameter).put(frame);
        }
    }
}
