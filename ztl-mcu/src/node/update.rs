//! Receives firmware updates from the gateway.

use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::parameter::NO_COMPONENT;
use ztl_core::link::update::{PIECE_UNIT, UpdateCommand, UpdateError, UpdateMessage, UpdatePhase};
use ztl_core::link::{FrameWriter, NO_SEQ};

use super::link_state::{Answer, Counters, LinkState, Other, count};
use super::refusal::Refusal;
use super::runner::TaskRunner;
use crate::component::{Components, Report};
use crate::update::{UpdateState, Verification};

/// An update without a command for so long is over; the node then takes tasks again.
const PATIENCE: Duration = Duration::from_secs(5);
/// The answer to all commands but the question for what runs.
const UPDATE: Answer = Answer::Other(Other::Update);
/// How long a verified image waits for the command to run it.
const READY: Duration = Duration::from_secs(30);
/// Pause before a restart, in which the answer to `Restart` is sent.
const FAREWELL: Duration = Duration::from_millis(100);
/// How long components may take to their safe state before a restart.
const SAFETY: Duration = Duration::from_secs(5);

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    /// Handles a command of the current session.
    pub(super) fn on_update_command(
        &mut self,
        now: Instant,
        (addr, seq, command): (u8, u8, UpdateCommand<'_>),
        counters: &mut Counters,
    ) {
        count(&mut counters.frames);
        if addr == self.address() && seq != NO_SEQ {
            self.in_sequence(now, seq, counters, |state, _| {
                // Like for any other command.
                state.check_link_timer(now);
                Some(state.runner.execute_update(now, command))
            });
        }
    }

    /// Verifies, restarts, and ends a trial or an update that does not go on.
    pub(super) fn on_update_timeout(&mut self, now: Instant) {
        // A step of the verification would delay an answer.
        let answers = self.answer_due || !self.frame_out.pending().is_empty();
        self.runner.on_update_timeout(now, answers);
    }

    /// When [`on_update_timeout`](Self::on_update_timeout) has work.
    pub(super) fn next_update(&self) -> Instant {
        let update = self.runner.components.update();
        update.map_or(Instant::NEVER, |(state, _)| state.next())
    }
}

impl<C: Components, const TASKS: usize> TaskRunner<C, TASKS> {
    fn execute_update(&mut self, now: Instant, command: UpdateCommand<'_>) -> Answer {
        if command == UpdateCommand::Read {
            return Answer::Other(Other::Firmware);
        }
        if let UpdateCommand::Begin {
            now: at_once,
            downgrade,
            manifest,
        } = command
        {
            return self.begin_update(now, at_once, downgrade, manifest);
        }
        let Some((state, updater)) = self.components.update_mut() else {
            return UPDATE;
        };
        // Commands do not put a restart off.
        if state.phase == UpdatePhase::Restarting {
            return UPDATE;
        }
        state.until = now + PATIENCE;
        match (command, state.phase) {
            (UpdateCommand::Write { offset, bytes }, UpdatePhase::Receiving { offset: at })
                if offset == at =>
            {
                let end = u32::try_from(bytes.len()).ok();
                let end = end.and_then(|len| offset.checked_add(len));
                let fits = |end: &u32| {
                    (bytes.len().is_multiple_of(PIECE_UNIT) || *end == state.length)
                        && *end <= state.length
                };
                let Some(end) = end.filter(fits) else {
                    return self.refuse("the piece does not fit the image");
                };
                state.phase = match updater.write(offset, bytes) {
                    Ok(()) => UpdatePhase::Receiving { offset: end },
                    Err(error) => UpdatePhase::Failed(error),
                };
            }
            (UpdateCommand::Finish, UpdatePhase::Receiving { offset })
                if offset == state.length =>
            {
                state.phase = UpdatePhase::Verifying;
            }
            (UpdateCommand::Restart, phase) => {
                let on_trial = state.trial_ends != Instant::NEVER;
                if phase == UpdatePhase::Ready || on_trial {
                    self.restart(now);
                }
            }
            (UpdateCommand::Confirm, UpdatePhase::Idle | UpdatePhase::Failed(_)) => {
                match updater.confirm() {
                    Ok(()) => state.trial_ends = Instant::NEVER,
                    Err(error) => state.phase = UpdatePhase::Failed(error),
                }
            }
            (UpdateCommand::Cancel, _) => state.phase = UpdatePhase::Idle,
            // A command that is repeated, or belongs to another phase, changes nothing.
            _ => {}
        }
        UPDATE
    }

    fn refuse(&mut self, reason: &str) -> Answer {
        Report::new(&mut self.reason).text(reason);
        Answer::Refused(Refusal::ByComponent)
    }

    fn begin_update(
        &mut self,
        now: Instant,
        at_once: bool,
        downgrade: bool,
        manifest: &[u8],
    ) -> Answer {
        let runs = self.tasks.0.iter().any(|task| task.is_open());
        if runs && !at_once {
            return self.refuse("a task runs, and the update would end it");
        }
        let Some((state, updater)) = self.components.update_mut() else {
            return UPDATE;
        };
        if state.phase == UpdatePhase::Restarting {
            return UPDATE;
        }
        state.until = now + PATIENCE;
        if !updater.firmware().confirmed {
            state.phase = UpdatePhase::Failed(UpdateError::OnTrial);
            return UPDATE;
        }
        if !state.is_active() {
            state.phase = UpdatePhase::Stopping;
            self.make_safe(now, true);
        }
        let moves = self.moves(NO_COMPONENT);
        if let Some((state, updater)) = self.components.update_mut() {
            if moves {
                state.phase = UpdatePhase::Stopping;
                return UPDATE;
            }
            state.phase = match updater.begin(manifest, downgrade) {
                Ok(receiving) => {
                    state.length = receiving.length;
                    let offset = receiving.offset;
                    UpdatePhase::Receiving { offset }
                }
                Err(error) => UpdatePhase::Failed(error),
            };
        }
        UPDATE
    }

    /// Restarts soon, when all components are safe.
    fn restart(&mut self, now: Instant) {
        let Some((state, _)) = self.components.update_mut() else {
            return;
        };
        let is_safe = state.is_active();
        state.trial_ends = Instant::NEVER;
        state.phase = UpdatePhase::Restarting;
        state.restart_at = now + FAREWELL;
        state.until = now + SAFETY;
        if !is_safe {
            self.make_safe(now, true);
        }
    }

    fn on_update_timeout(&mut self, now: Instant, answers: bool) {
        let Some((state, updater)) = self.components.update_mut() else {
            return;
        };
        if !core::mem::replace(&mut state.has_begun, true) {
            let firmware = updater.firmware();
            if !firmware.confirmed {
                let trial = Duration::from_millis(firmware.trial_ms.into());
                state.trial_ends = now + trial;
            }
        }
        if now >= state.trial_ends {
            self.restart(now);
        }
        let moves = self.moves(NO_COMPONENT);
        let Some((state, updater)) = self.components.update_mut() else {
            return;
        };
        match state.phase {
            // An answer that cannot be sent does not hold it up for ever.
            UpdatePhase::Verifying if !answers || now >= state.until => {
                state.phase = match updater.verify() {
                    Ok(Verification::Continues) => UpdatePhase::Verifying,
                    Ok(Verification::Done) => {
                        // The link may be lost by now: a verification may take seconds.
                        state.until = now + READY;
                        UpdatePhase::Ready
                    }
                    Err(error) => UpdatePhase::Failed(error),
                };
            }
            UpdatePhase::Restarting if now >= state.restart_at => {
                state.restart_at = now + FAREWELL;
                if !moves || now >= state.until {
                    updater.restart();
                }
            }
            // It goes on to its end, also after a time without commands.
            UpdatePhase::Verifying | UpdatePhase::Restarting => {}
            _ if state.is_active() && now >= state.until => state.phase = UpdatePhase::Idle,
            _ => {}
        }
    }

    /// Encodes the answer to a command about updates.
    pub(super) fn put_update(&self, answer: Other, frame: &mut FrameWriter<'_>) {
        if let Some((state, updater)) = self.components.update() {
            let message = match answer {
                Other::Firmware => UpdateMessage::Firmware(updater.firmware()),
                _ => UpdateMessage::Phase(state.phase),
            };
            message.put(frame);
        }
    }
}

impl UpdateState {
    /// When there is work.
    fn next(&self) -> Instant {
        let work = match self.phase {
            // While components are on their way to the safe state, they ask for their own turns.
            UpdatePhase::Verifying => Instant::ZERO,
            UpdatePhase::Restarting => self.restart_at,
            _ if self.is_active() => self.until,
            _ => Instant::NEVER,
        };
        let first = if self.has_begun {
            self.trial_ends
        } else {
            Instant::ZERO
        };
        work.min(first)
    }
}
