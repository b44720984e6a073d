//! Cues: tasks that the operator starts beside the scene that plays.

use std::sync::Arc;

use ztl_core::Instant;

use super::state::{Phase, Player, RunTask};
use crate::event::RunEvent;

impl Player {
    /// Starts the tasks of a cue.
    ///
    /// # Errors
    /// Why nothing was started. A cue whose tasks still run is not started again.
    pub(crate) fn start_cue(&mut self, now: Instant, cue: usize) -> Result<(), &'static str> {
        match &self.phase {
            Phase::Idle | Phase::Playing(_) => {}
            Phase::Stopping(_) => {
                return Err("tasks are being stopped: press it when that is over");
            }
            Phase::Settling(_) | Phase::Over => return Err("the show has ended"),
        }
        let script = Arc::clone(&self.script);
        let plan = script.cues.get(cue).ok_or("there is no such cue")?;
        // Of a task that is lost, nobody will hear.
        let may_end = |task: &RunTask| task.unknown.is_none() || task.can_be_asked();
        let mut live = self.live.iter().filter_map(|number| self.tasks.get(number));
        if live.any(|task| task.cue.is_some_and(|(of, _)| of == cue) && may_end(task)) {
            return Err("it still runs");
        }
        for (part, task) in plan.step.tasks.iter().enumerate() {
            let Some(handler) = plan.step.handler(task) else {
                continue;
            };
            let number = self.number_task();
            self.emit(RunEvent::CueStarting {
                task: number,
                cue,
                part,
            });
            let new = RunTask {
                cue: Some((cue, part)),
                ..RunTask::new(now, handler.remote.clone())
            };
            self.init(now, (number, new), handler, task);
        }
        self.advance(now);
        Ok(())
    }
}
