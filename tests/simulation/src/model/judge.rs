//! The promises, as checks of the model.

use std::time::Duration;

use ztl_core::State;
use ztl_core::link::{LINK_TIMEOUT, Loss};

use super::ends::link::LinkEvent;
use super::gateway::Told;
use super::line::Parcel;
use super::link::{LinkModel, gateway_of};

/// When a node makes a component safe again that failed to become safe.
const SAFETY_INTERVAL: Duration = Duration::from_millis(50);

impl LinkModel {
    pub(super) fn on_sent(&mut self, parcel: &Parcel) -> Result<(), String> {
        let opens = parcel.is("Welcome") && parcel.session != self.answered.0;
        let executed = parcel.seq != 0 && (parcel.session, parcel.seq) != self.answered && !opens;
        if opens {
            let gateway = gateway_of(parcel.session);
            let live = |heard| self.now < heard + LINK_TIMEOUT;
            if let Some((holder, heard)) = self.holder
                && holder != gateway
                && live(heard)
            {
                return Err("promise: the device of one gateway is given to another".to_owned());
            }
            self.holder = Some((gateway, self.now));
            self.answered = (parcel.session, 0);
        } else if executed {
            self.answered = (parcel.session, parcel.seq);
            self.commanded = self.now;
            if let Some((_, heard)) = &mut self.holder {
                *heard = self.now;
            }
        }
        Ok(())
    }

    /// Checks an event of a session.
    pub(super) fn on_event(&mut self, event: LinkEvent) -> Result<(), String> {
        let (id, told, text) = match event {
            LinkEvent::Accepted(id) => (id, Told::Accepted, String::new()),
            LinkEvent::TaskRejected(id, text) => (id, Told::Rejected, text),
            LinkEvent::Ended(id, state, text) => (id, Told::Ended(state), text),
            event => return self.on_set_answer(&event),
        };
        let task = id.get() as usize - 1;
        if self.is_told_again(task, told, &text) {
            return Ok(());
        }
        let client = self.clients[task];
        let again = client.told == told && told == Told::Accepted && self.scenario.journal;
        let first = match told {
            Told::Accepted | Told::Rejected => client.told == Told::Nothing,
            _ => !client.told.is_final(),
        };
        if !first && !again {
            return Err(format!(
                "promise 2: task {task} was told {:?} and is told {told:?} ({text})",
                client.told
            ));
        }
        self.clients[task].told = told;
        self.judge_end(task, told, &text)
    }

    /// Checks a reported state against the truth.
    fn judge_end(&self, task: usize, told: Told, text: &str) -> Result<(), String> {
        let client = self.clients[task];
        let execution = self.truth.tasks[task];
        let lie = |promise: u8, why: &str| {
            Err(format!(
                "promise {promise}: task {task} is told {told:?} ({text}), {why}"
            ))
        };
        let Told::Ended(state) = told else {
            return Ok(());
        };
        match (state, text) {
            (State::Completed, _) if execution.came_to != Some(State::Completed) => {
                lie(2, "but its motor did not come to its goal")
            }
            // Another gateway has aborted it, or its `Start` never arrived: the gateway cannot know more.
            (State::Failed, "the device no longer holds the task") if self.gateways.len() == 1 => {
                lie(2, "but it does until that is known here")
            }
            (State::Aborted, _)
                if execution.begun > 0 && execution.came_to != Some(State::Aborted) =>
            {
                lie(2, "but its motor was not stopped by that")
            }
            (State::Failed, "device was reset") if client.boot == self.boot => {
                lie(3, "but it was not")
            }
            (State::Failed, "device is not answering") => {
                let kind = self.scenario.motors[client.motor];
                match kind.loss {
                    Loss::CarryOn => lie(4, "but it carries on"),
                    _ => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }

    /// Checks what must hold at any time.
    pub(super) fn judge(&self) -> Result<(), String> {
        for (task, (execution, client)) in self.truth.tasks.iter().zip(&self.clients).enumerate() {
            if execution.begun > 1 {
                return Err(format!("promise 1: task {task} is begun twice"));
            }
            if client.told == Told::Rejected && execution.begun > 0 {
                return Err(format!("promise 6: task {task} was rejected and moves"));
            }
            // A device that is not answering may take this time: clause 8.4. The check below bounds it.
            let kind = self.scenario.motors[client.motor];
            let fails = kind.fails && client.told == Told::Ended(State::Failed);
            if client.told.is_final() && !fails && self.truth.moves(task) {
                return Err(format!(
                    "promise 4: task {task} was told {:?} and its motor moves",
                    client.told
                ));
            }
        }
        for (motor, kind) in self.scenario.motors.iter().enumerate() {
            let tries = SAFETY_INTERVAL * kind.fails.into();
            let lost = self.now > self.commanded + LINK_TIMEOUT + tries;
            if !lost || kind.loss == Loss::CarryOn {
                continue;
            }
            if self.truth.moving[motor].is_some() {
                return Err(format!("promise 4: motor {motor} moves without a link"));
            }
            if self.truth.powered[motor] {
                return Err(format!(
                    "promise 4: motor {motor} is not in its safe state without a link"
                ));
            }
        }
        self.judge_sets()
    }
}
