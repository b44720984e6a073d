//! Tasks that the device starts itself: the button that starts them, and the gateway that takes them up.

use ztl_core::Instant;

use super::gateway::Told;
use super::link::{Client, LabSession, LinkModel, task_id};
use super::motor::{ENDLESS, with_truth};

/// What is known of a task that the device has started itself.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct OwnTask {
    /// Whether a client has not started it.
    pub(super) own: bool,
    /// Whether its gateway has taken it up.
    pub(super) taken: bool,
    /// Whether a gateway that has no journal has taken it up although its end was told before: it tells the end again.
    pub(super) again: bool,
}

/// Takes up the task that the device has begun. Returns the task, if it could be taken up.
pub(super) fn take_up(session: &mut LabSession, now: Instant) -> Option<usize> {
    let goal = session.begun()?.goal.clone();
    let task: usize = goal.split(' ').next()?.parse().ok()?;
    session.take_up(now, task_id(task)).then_some(task)
}

impl LinkModel {
    /// A button of the device is pressed.
    pub(super) fn press(&mut self, motor: usize, millis: u16) -> Result<(), String> {
        let task = self.asked;
        self.asked += 1;
        let node_now = self.node_now();
        let goal = format!("{task} {millis}");
        let node = &mut self.node;
        let started = with_truth(&mut self.truth, || {
            node.start_here(node_now, motor as u8, &goal)
        });
        self.note(|| format!("  pressed: {started:?}"));
        let mut client = Client {
            told: Told::Nothing,
            gateway: 0,
            motor,
            endless: millis == ENDLESS,
            boot: self.boot,
            ..Client::default()
        };
        client.own.own = true;
        if !started {
            // The device has already reported the refusal at the button.
            client.told = Told::Rejected;
        }
        self.clients[task] = client;
        Ok(())
    }

    /// A gateway has taken up a task of the device.
    pub(super) fn on_taken(&mut self, task: usize) -> Result<(), String> {
        self.note(|| format!("  task {task} of the device is taken up"));
        let client = &mut self.clients[task];
        if client.own.taken {
            return Err(format!(
                "promise 7: task {task} of the device gets a second id"
            ));
        }
        client.own.taken = true;
        if client.told.is_final() {
            client.own.again = true;
        } else {
            client.told = Told::Accepted;
        }
        Ok(())
    }

    /// The gateway is killed after it has told the end. Without its journal, it takes the task up again if the device has not
    /// heard that the end arrived.
    pub(super) fn forget_end(&mut self, task: usize) {
        let own = &mut self.clients[task].own;
        (own.taken, own.again) = (false, false);
    }

    /// Whether the end of this task is told as it was told to an earlier gateway, or that gateway's `Ack` has arrived meanwhile.
    pub(super) fn is_told_again(&mut self, task: usize, told: Told, text: &str) -> bool {
        let client = &mut self.clients[task];
        std::mem::take(&mut client.own.again)
            && (told == client.told || text == "the device no longer holds the task")
    }

    /// The gateway is killed. Returns whether that decides nothing for this task.
    pub(super) fn is_untaken_after_kill(&mut self, task: usize, is_kept: bool) -> bool {
        let client = &mut self.clients[task];
        if !client.own.own || client.told == Told::Rejected {
            return false;
        }
        // An abort that its gateway has not sent is lost with it.
        client.aborted = false;
        if !is_kept {
            // The restarted gateway takes it up again.
            client.told = Told::Nothing;
            client.own = OwnTask {
                own: true,
                ..OwnTask::default()
            };
        }
        !client.own.taken
    }

    /// A task of the device that no gateway has taken up, when there has been time to.
    pub(super) fn judge_untaken(&self, task: usize) -> Result<(), String> {
        let client = &self.clients[task];
        if self.truth.moves(task) || client.boot == self.boot {
            return Err(format!(
                "promise 7: task {task} of the device is never taken up"
            ));
        }
        Ok(())
    }
}
