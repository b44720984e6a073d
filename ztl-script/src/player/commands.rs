//! What the operator wants.

use ztl_core::Instant;

use super::super::event::{By, Command, Event, Outcome, Question};
use super::{Phase, Player};

impl Player {
    /// What can be wanted now; nothing else does anything.
    #[must_use]
    pub fn choices(&self) -> Vec<Command> {
        let mut choices = Vec::new();
        // Nobody jumps where nobody is asked.
        let scenes = if self.options.unattended {
            0
        } else {
            self.script.scenes.len()
        };
        let jumps = || (0..scenes).map(|scene| Command::Jump { scene });
        match (&self.phase, self.question) {
            (Phase::Over(_), _) => {}
            (Phase::Stopping(stopping), _) => choices.extend(stopping.choices()),
            (Phase::Settling(_), _) => choices.push(Command::Leave),
            (_, Some(Question::Scene { .. } | Question::End)) => {
                if matches!(self.question, Some(Question::Scene { .. })) {
                    choices.extend([Command::Start, Command::Skip]);
                }
                if self.last.is_some() {
                    choices.push(Command::Replay);
                }
                if !self.failed.is_empty() {
                    choices.push(Command::Retry);
                }
                choices.push(Command::Restart);
                choices.extend(jumps());
                choices.extend([Command::StopAll, Command::Stop, Command::Leave]);
            }
            (_, Some(Question::Step { .. })) => {
                if self.can_try_again() {
                    choices.push(Command::Retry);
                }
                choices.extend([Command::GoOn, Command::Skip]);
                choices.extend([Command::StopScene, Command::StopAll]);
                choices.extend([Command::Stop, Command::Leave]);
            }
            (_, Some(Question::Pause)) => {
                choices.extend([Command::Resume, Command::Skip, Command::Restart]);
                choices.extend(jumps());
                choices.extend([Command::StopScene, Command::StopAll]);
                choices.extend([Command::Stop, Command::Leave]);
            }
            (Phase::Playing(_), None) => choices.extend(Command::WHILE_RUNNING),
            (Phase::Idle, None) => {}
        }
        // Without an operator the scene would be played again at once.
        if self.options.unattended {
            choices.retain(|choice| !matches!(choice, Command::StopScene | Command::StopAll));
        }
        choices
    }

    /// Somebody wants something. What is none of the [`choices`](Self::choices) does nothing, and says so
    /// with `false`; but a [`Command::Stop`] is taken at any time, and a second one leaves. A
    /// [`Command::StopAll`] where nothing is left to return to is a [`Command::Stop`].
    pub fn handle_command(&mut self, now: Instant, command: Command, by: By) -> bool {
        let over = matches!(self.phase, Phase::Over(_));
        let settling = matches!(self.phase, Phase::Settling(_));
        let ends = settling || matches!(&self.phase, Phase::Stopping(it) if it.then.is_none());
        let command = match command {
            Command::Stop if ends => Command::Leave,
            Command::StopAll if settling || (self.options.unattended && !ends) => Command::Stop,
            command => command,
        };
        let urgent = command == Command::Stop || (command == Command::Leave && ends);
        if over || !(urgent || self.choices().contains(&command)) {
            return false;
        }
        self.obey(now, command, by);
        self.advance(now);
        true
    }

    pub(super) fn obey(&mut self, now: Instant, command: Command, by: By) {
        if matches!(
            command,
            Command::StopScene | Command::StopAll | Command::Stop
        ) {
            return self.stop(now, command, by);
        }
        let (scene, step) = self.place();
        self.events.push_back(Event::Decided {
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
            Command::Start => self.play(now, shown, (shown, self.after(shown)), false),
            Command::Skip => match question {
                Some(Question::Scene { .. }) => {
                    self.events
                        .push_back(Event::SceneSkipped { scene: shown, by });
                    self.show(self.after(shown));
                }
                _ => {
                    let then = self.then();
                    self.excuse();
                    self.leave_play();
                    self.show(then);
                }
            },
            Command::Replay => {
                if let Some(last) = self.last {
                    self.play(now, last, (shown, shown), true);
                }
            }
            Command::Retry if matches!(question, Some(Question::Step { .. })) => {
                self.try_again(now);
                self.question = None;
            }
            Command::Retry => {
                if let Some(last) = self.last {
                    self.play_failed(now, last, shown);
                }
            }
            Command::Jump { scene } => {
                self.leave_play();
                self.show(scene);
            }
            Command::Restart => {
                self.leave_play();
                self.last = None;
                self.failed.clear();
                self.show(self.first());
            }
            Command::Pause | Command::Resume => self.pause(command == Command::Pause),
            Command::GoOn => self.excuse(),
            Command::Leave => match (&self.phase, question) {
                // It has come to its end.
                (Phase::Idle, Some(Question::End)) => self.leave(now),
                (Phase::Settling(_), _) => self.over(self.fate()),
                _ => {
                    self.leave_play();
                    self.over(Outcome::Left);
                }
            },
            Command::StopScene | Command::StopAll | Command::Stop => {}
        }
    }

    fn pause(&mut self, wanted: bool) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        if !wanted && play.is_paused() {
            return self.resume();
        }
        play.pause = wanted;
    }

    /// The scene and step that are under way or shown.
    pub(super) fn place(&self) -> (Option<usize>, Option<usize>) {
        match (&self.phase, self.question) {
            (Phase::Playing(play), _) => {
                (Some(play.scene), play.step.as_ref().map(|step| step.step))
            }
            (_, Some(Question::Scene { scene })) => (Some(scene), None),
            _ => (None, None),
        }
    }

    /// What comes after a scene that is played.
    fn then(&self) -> usize {
        match &self.phase {
            Phase::Playing(play) => play.then,
            _ => self.script.scenes.len(),
        }
    }

    /// What comes after a scene.
    fn after(&self, scene: usize) -> usize {
        match self.options.scene {
            Some(_) => self.script.scenes.len(),
            None => scene + 1,
        }
    }
}
