//! Commands of the operator, the options, the script and signals.

use ztl_core::Instant;

use super::state::{Phase, Player, Stopping};
use crate::event::{DecidedBy, Question, RunCommand, RunEvent, RunOutcome};

impl Player {
    /// The commands that are accepted now.
    pub(crate) fn choices(&self) -> Vec<RunCommand> {
        let mut choices = Vec::new();
        // An unattended run never jumps.
        let scenes = match self.options.unattended {
            true => 0,
            false => self.script.scenes.len(),
        };
        let jumps = || (0..scenes).map(|scene| RunCommand::Jump { scene });
        match (&self.phase, self.question) {
            (Phase::Over, _) => {}
            (Phase::Stopping(stopping), _) => choices.extend(while_stopping(stopping)),
            (Phase::Settling(_), _) => choices.push(RunCommand::Leave),
            (_, Some(Question::Scene { .. } | Question::End)) => {
                if matches!(self.question, Some(Question::Scene { .. })) {
                    choices.extend([RunCommand::Start, RunCommand::Skip]);
                }
                if self.last.is_some() {
                    choices.push(RunCommand::Replay);
                }
                if !self.failed.is_empty() {
                    choices.push(RunCommand::Retry);
                }
                choices.push(RunCommand::Restart);
                choices.extend(jumps());
                choices.extend([RunCommand::StopAll, RunCommand::Stop, RunCommand::Leave]);
            }
            (_, Some(Question::Step { .. } | Question::Pause)) => {
                if self.question == Some(Question::Pause) {
                    choices.extend([RunCommand::Resume, RunCommand::Skip, RunCommand::Restart]);
                    choices.extend(jumps());
                } else {
                    if self.can_retry() {
                        choices.push(RunCommand::Retry);
                    }
                    choices.extend([RunCommand::GoOn, RunCommand::Skip]);
                }
                choices.extend([RunCommand::StopScene, RunCommand::StopAll]);
                choices.extend([RunCommand::Stop, RunCommand::Leave]);
            }
            (Phase::Playing(_), None) => choices.extend(RunCommand::WHILE_RUNNING),
            (Phase::Idle, None) => {}
        }
        // An unattended run would play the scene again at once.
        if self.options.unattended {
            choices.retain(|choice| !matches!(choice, RunCommand::StopScene | RunCommand::StopAll));
        }
        choices
    }

    /// Carries out a command; returns `false` and does nothing if it is not among the
    /// [`choices`](Self::choices). [`RunCommand::Stop`] is accepted at any time; a second one leaves.
    /// [`RunCommand::StopAll`] means [`RunCommand::Stop`] when there is nothing to return to.
    pub(crate) fn handle_command(
        &mut self,
        now: Instant,
        command: RunCommand,
        by: DecidedBy,
    ) -> bool {
        let over = matches!(self.phase, Phase::Over);
        let settling = matches!(self.phase, Phase::Settling(_));
        let ends = settling || matches!(&self.phase, Phase::Stopping(it) if it.then.is_none());
        let command = match command {
            RunCommand::Stop if ends => RunCommand::Leave,
            RunCommand::StopAll if settling || (self.options.unattended && !ends) => {
                RunCommand::Stop
            }
            command => command,
        };
        let urgent = command == RunCommand::Stop || (command == RunCommand::Leave && ends);
        if over || !(urgent || self.choices().contains(&command)) {
            return false;
        }
        self.obey(now, command, by);
        self.advance(now);
        true
    }

    pub(super) fn obey(&mut self, now: Instant, command: RunCommand, by: DecidedBy) {
        let (scene, step) = self.place();
        self.emit(RunEvent::Decided {
            command,
            by,
            scene,
            step,
        });
        let question = self.question;
        let shown = match question {
            Some(Question::Scene { scene }) => scene,
            _ => self.script.scenes.len(),
        };
        match command {
            RunCommand::Start => self.play(now, shown, (shown, self.after(shown)), false),
            RunCommand::Skip => match question {
                Some(Question::Scene { .. }) => {
                    self.emit(RunEvent::SceneSkipped { scene: shown, by });
                    self.show(self.after(shown));
                }
                _ => {
                    let then = self.play_mut().map(|play| play.then);
                    self.excuse();
                    self.leave_play();
                    self.show(then.unwrap_or(shown));
                }
            },
            RunCommand::Replay => {
                if let Some(last) = self.last {
                    self.play(now, last, (shown, shown), true);
                }
            }
            RunCommand::Retry if matches!(question, Some(Question::Step { .. })) => {
                self.retry(now);
                self.question = None;
            }
            RunCommand::Retry => {
                if let Some(last) = self.last {
                    self.play_failed(now, last, shown);
                }
            }
            RunCommand::Jump { scene } => {
                self.leave_play();
                self.show(scene);
            }
            RunCommand::Restart => {
                self.leave_play();
                self.last = None;
                self.failed.clear();
                self.show(self.first());
            }
            RunCommand::Pause | RunCommand::Resume => self.pause(command == RunCommand::Pause),
            RunCommand::GoOn => self.excuse(),
            RunCommand::Leave => match (&self.phase, question) {
                (Phase::Idle, Some(Question::End)) => self.leave(now),
                (Phase::Settling(_), _) => self.end_run(self.final_outcome()),
                (Phase::Stopping(_), _) => self.end_run(self.stop_outcome()),
                _ => {
                    self.leave_play();
                    self.end_run(match self.final_outcome() {
                        RunOutcome::Completed => RunOutcome::Left,
                        failures => failures,
                    });
                }
            },
            RunCommand::StopScene | RunCommand::StopAll | RunCommand::Stop => {
                self.stop(now, command, scene);
            }
        }
    }

    fn pause(&mut self, wanted: bool) {
        let Some(play) = self.play_mut() else {
            return;
        };
        if !wanted && play.stage.is_paused() {
            return self.resume();
        }
        play.pause = wanted;
    }

    /// The scene and step that are playing, or the scene that is shown.
    fn place(&self) -> (Option<usize>, Option<usize>) {
        match (&self.phase, self.question) {
            (Phase::Playing(play), _) => {
                (Some(play.scene), play.step.as_ref().map(|step| step.step))
            }
            (_, Some(Question::Scene { scene })) => (Some(scene), None),
            _ => (None, None),
        }
    }

    /// The scene after this one.
    fn after(&self, scene: usize) -> usize {
        match self.options.scene {
            Some(_) => self.script.scenes.len(),
            None => scene + 1,
        }
    }
}

/// The commands accepted while tasks are being stopped: those that stop more.
fn while_stopping(stopping: &Stopping) -> &'static [RunCommand] {
    match (stopping.then, stopping.all) {
        (None, _) => &[RunCommand::Leave],
        (Some(_), true) => &[RunCommand::Stop],
        (Some(_), false) => &[RunCommand::StopAll, RunCommand::Stop],
    }
}
