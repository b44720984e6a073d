//! The player's inputs and outputs, except [answers](super::answers) and [commands](super::commands).

use ztl_core::Instant;

use super::state::{Phase, Player, Request};
use crate::event::{DecidedBy, Question, RunEvent, RunOutcome};

impl Player {
    /// Shows the first scene. To be called once, before anything else.
    pub(crate) fn begin(&mut self, now: Instant) {
        let first = self.first();
        for scene in 0..first {
            let by = DecidedBy::Options;
            self.emit(RunEvent::SceneSkipped { scene, by });
        }
        self.show(first);
        if self.options.watch {
            let remotes = self.options.remotes.iter();
            self.probes = remotes.map(|name| (name.clone(), Some(now))).collect();
        }
        self.advance(now);
    }

    /// The time that [`poll_timeout`](Self::poll_timeout) returned has come.
    pub(crate) fn handle_time(&mut self, now: Instant) {
        self.probe(now);
        self.watch(now);
        self.advance(now);
    }

    /// The next request to send.
    pub(crate) fn poll_request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }

    /// The next event.
    pub(crate) fn poll_event(&mut self) -> Option<RunEvent> {
        self.events.pop_front()
    }

    /// When to call [`handle_time`](Self::handle_time) if no other input comes.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let step = match &self.phase {
            Phase::Over => return None,
            Phase::Playing(play) => play.wake(),
            _ => None,
        };
        let tasks = self
            .live
            .iter()
            .filter_map(|number| self.task_wake(*number));
        tasks.chain(step).chain(self.probe_wake()).min()
    }

    /// The open question to the operator.
    pub(crate) const fn question(&self) -> Option<Question> {
        self.question
    }

    /// The first scene to show.
    pub(super) fn first(&self) -> usize {
        let from = self.options.from.map(|(scene, _)| scene);
        self.options.scene.or(from).unwrap_or(0)
    }

    /// Shows a scene, or after the last one asks what to do next.
    pub(super) fn show(&mut self, scene: usize) {
        self.phase = Phase::Idle;
        if scene < self.script.scenes.len() {
            self.emit(RunEvent::SceneShown { scene });
            self.ask(Question::Scene { scene });
        } else {
            self.ask(Question::End);
        }
    }

    pub(super) fn ask(&mut self, question: Question) {
        self.question = Some(question);
        let choices = self.choices();
        self.emit(RunEvent::Asked { question, choices });
    }

    pub(super) fn end_run(&mut self, outcome: RunOutcome) {
        let running = self.live.iter().copied().collect();
        self.question = None;
        self.requests.clear();
        self.phase = Phase::Over;
        self.emit(RunEvent::RunEnded {
            outcome,
            running,
            text: String::new(),
        });
    }

    /// The outcome if the run ends now by itself.
    pub(super) fn final_outcome(&self) -> RunOutcome {
        match self.unresolved.is_empty() {
            true => RunOutcome::Completed,
            false => RunOutcome::Failures,
        }
    }
}
