//! Which board answers at an address of a shared line (`docs/link.md`, 15.8): a board with another boot was reset, or it is
//! another board, and the one before still carries out its tasks.

use ztl_core::link::{ADDR_ONLY_NODE, Body, Welcome};
use ztl_core::{Instant, State, TaskId};

use super::{CommandKind, Phase, Session};
use crate::event::LinkEvent;
use crate::journal::{Sent, SessionJournal};
use crate::task::Task;

/// Searches that must find the board alone at its address: the first one may have begun before the other board came.
const SEARCHES: u8 = 2;

/// What a session has heard from another board.
#[derive(Debug, Clone, Default)]
pub(crate) struct Doubt {
    /// The boot that was announced last while the device answered.
    boot: Option<u32>,
    /// The one that was told last.
    told: Option<u32>,
    /// Searches in a row that found the board alone.
    alone: u8,
}

impl<J: SessionJournal> Session<J> {
    /// Whether the session cannot tell a reset of its device from another board.
    pub(crate) fn is_shared(&self) -> bool {
        let alone = self.address == ADDR_ONLY_NODE;
        !alone
    }

    /// Whether the task was sent to an earlier boot, or to another board, and may still run there.
    pub(crate) fn is_astray(&self, task: &Task) -> bool {
        let known = self.device.as_ref().map(|device| device.boot);
        let sent = task.stage.sent();
        self.is_shared() && self.answers() && sent.is_some_and(|sent| Some(sent.boot) != known)
    }

    /// The other boots whose tasks may still run, on a board that has or had this address.
    #[must_use]
    pub fn astray_boots(&self) -> Vec<u32> {
        let tasks = self.tasks.values();
        let astray = tasks.filter(|task| task.may_run() && self.is_astray(task));
        let boots = astray.filter_map(|task| task.stage.sent());
        let mut boots: Vec<u32> = boots.map(|sent| sent.boot).collect();
        boots.sort_unstable();
        boots.dedup();
        boots
    }

    /// Handles the announcement of another boot on a shared line. Returns `false` if the session is to be opened again, because
    /// no task can be lost.
    pub(crate) fn doubts_announcement(&mut self, now: Instant, boot: u32) -> bool {
        if !self.is_shared() || !self.tasks.values().any(Task::may_run) {
            return false;
        }
        if self.doubt.boot != Some(boot) {
            self.doubt.boot = Some(boot);
            // Only the board of this session answers. If it was reset, the session is lost.
            if self.in_flight.is_none() && self.phase == Phase::Up {
                self.command(now, CommandKind::Ping, Body::Ping);
            }
        }
        true
    }

    /// Whether the welcome of another boot must wait: tasks of the one before may run, and end by themselves soon.
    pub(crate) fn doubts_welcome(&mut self, now: Instant, welcome: &Welcome<'_>) -> bool {
        let mut tasks = self.tasks.values().filter(|task| task.may_run());
        let waits = self.is_shared()
            && tasks.any(|task| {
                let other = task
                    .stage
                    .sent()
                    .is_some_and(|sent| of_other(sent, welcome));
                other && !task.carries_on() && now < self.must_have_acted(task)
            });
        if !waits {
            return false;
        }
        if self.doubt.boot.replace(welcome.boot) != Some(welcome.boot) {
            self.events.push_back(LinkEvent::OtherBoard);
        }
        if let Some(in_flight) = &mut self.in_flight {
            // It is asked again, but it is not silent.
            in_flight.sent = now;
        }
        true
    }

    /// Why the tasks of a device have failed that has not answered for so long that it has ended them by itself.
    pub(crate) fn why_unreachable(&self) -> &'static str {
        match self.doubt.boot {
            Some(_) if self.is_shared() => "device was reset, or another board has its address",
            _ => "device is not answering",
        }
    }

    /// Whether a task keeps its state although another boot answers: the board before may carry it on.
    pub(crate) fn stays(&self, task: &Task, welcome: &Welcome<'_>) -> bool {
        let other = |sent: Sent| sent.boot != welcome.boot;
        self.is_shared() && task.carries_on() && task.stage.sent().is_some_and(other)
    }

    /// The tasks of another boot that may still run.
    fn astray(&self) -> Vec<TaskId> {
        let tasks = self.tasks.iter();
        let astray = tasks.filter(|(_, task)| task.may_run() && self.is_astray(task));
        astray.map(|(id, _)| *id).collect()
    }

    /// Tasks of another boot keep their state in the session that begins. `known`: its boot is that of the session before, so
    /// what searches have found since that began still counts.
    pub(crate) fn leave_astray(&mut self, known: bool) {
        let alone = self.doubt.alone;
        self.doubt = Doubt::default();
        let astray = self.astray();
        if known {
            self.doubt.alone = alone;
        } else if !astray.is_empty() {
            self.events.push_back(LinkEvent::OtherBoard);
        }
        for id in astray {
            let text =
                "the device was reset, or another board has its address: the task may still run";
            self.events
                .push_back(LinkEvent::Progress(id, text.to_owned()));
        }
    }

    /// A search of the shared line has ended. `alone`: it found the board that had this address before, and no other one with
    /// this address. After two of them, a board with another boot that answers is this board after a reset.
    pub fn handle_search(&mut self, alone: bool) {
        self.doubt.alone = match alone {
            true => self.doubt.alone.saturating_add(1).min(SEARCHES),
            false => 0,
        };
    }

    /// The board has answered a command.
    pub(crate) fn on_board_answered(&mut self, now: Instant) {
        // Two boards: the one of this session still answers.
        if self.answers() && self.doubt.told != self.doubt.boot {
            self.doubt.told = self.doubt.boot;
            self.events.push_back(LinkEvent::OtherBoard);
        }
        if self.doubt.alone < SEARCHES {
            return;
        }
        let reset = self.astray();
        if !reset.is_empty() {
            self.events.push_back(LinkEvent::Reset);
        }
        for id in reset {
            self.end(now, id, State::Failed, "device was reset");
        }
    }
}

/// Whether a task was sent to another boot than this one, or to one before a reset.
pub(crate) fn of_other(sent: Sent, welcome: &Welcome<'_>) -> bool {
    sent.boot != welcome.boot || welcome.replaces == 0
}
