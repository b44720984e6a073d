//! The steps of the model and their effects.

use std::time::Duration;

use ztl_core::State;
use ztl_core::link::LINK_TIMEOUT;

use super::gateway::Told;
use super::line::Way;
use super::link::{Client, Gateway, LabSession, LinkModel};
use super::motor::{TASKS, Truth};
use super::node::SomeNode;
use super::own::take_up;
use super::words::{Act, Action, Fault};
use crate::explore::System;
use crate::fingerprint::{Fingerprint, Origin};

/// A promise is broken when more than the link timeout has passed.
const MOMENT: Duration = Duration::from_micros(1);

impl LinkModel {
    fn can_act(&self) -> bool {
        let Some(act) = self.scenario.acts.get(self.acts) else {
            return false;
        };
        match *act {
            Act::Ask { gateway, .. } | Act::Abort { gateway, .. } | Act::Set { gateway, .. } => {
                self.gateways[gateway].session.is_some()
            }
            Act::Press { .. } => true,
            Act::Idle => self.can_idle(),
        }
    }

    fn can(&self, fault: Fault) -> bool {
        let lane = |way| match way {
            Way::Down => &self.down,
            Way::Up => &self.up,
        };
        match fault {
            Fault::Drop(way) => lane(way).brings(),
            Fault::Hold(way) | Fault::Copy(way) => lane(way).brings() && self.held.len() < 2,
            Fault::Tape(way) => lane(way).tape.is_none(),
            Fault::Stall(way) | Fault::Cut(way) => {
                let lane = lane(way);
                !lane.stalled && !lane.cut
            }
            Fault::Reset => true,
            Fault::Kill(gateway) => self.gateways[gateway].session.is_some(),
            Fault::KillWriting(gateway) => {
                self.up.brings() && self.gateways[gateway].session.is_some()
            }
            Fault::Unplug => self.plugged,
        }
    }

    pub(super) fn disturb(&mut self, fault: Fault) -> Result<(), String> {
        self.times = self.times.saturating_sub(1);
        match fault {
            Fault::Drop(way) => {
                self.lane(way).queue.pop_front();
            }
            Fault::Hold(way) => {
                let parcel = self.lane(way).queue.pop_front();
                self.held.extend(parcel.map(|parcel| (way, parcel)));
            }
            Fault::Copy(way) => {
                let parcel = self.lane(way).queue.front().cloned();
                self.held.extend(parcel.map(|parcel| (way, parcel)));
            }
            Fault::Tape(way) => self.lane(way).tape = Some(Vec::new()),
            Fault::Stall(way) => self.lane(way).stalled = true,
            Fault::Cut(way) => self.lane(way).cut = true,
            Fault::Reset => {
                self.boot += 1;
                self.booted = self.now;
                self.node = SomeNode::new(self.scenario, self.boot, self.address);
                self.truth.rest();
                self.holder = None;
                self.answered = (0, 0);
            }
            Fault::Kill(gateway) => self.kill(gateway),
            Fault::KillWriting(gateway) => {
                let parcel = self.up.queue.pop_front();
                self.lend_numbers(gateway);
                if let (Some(parcel), Some(session)) = (parcel, &mut self.gateways[gateway].session)
                {
                    session.handle_bytes(self.now, &parcel.bytes);
                    let taken = take_up(session, self.now);
                    if let Some(task) = taken {
                        self.on_taken(task)?;
                    }
                }
                self.take_numbers(gateway);
                self.kill(gateway);
            }
            Fault::Unplug => {
                self.plugged = false;
                for gateway in 0..self.gateways.len() {
                    self.with_session(gateway, LabSession::handle_disconnected)?;
                }
            }
        }
        Ok(())
    }

    pub(super) fn fingerprinter(&self) -> Fingerprint {
        let node = self.node_now();
        Fingerprint::new(Origin { now: node, node })
    }

    /// Adds everything to a fingerprint that [`fingerprinter`](Self::fingerprinter) has made.
    pub(super) fn add_to(&self, print: &mut Fingerprint) {
        let (session, seq) = self.answered;
        print.add(&format_args!("session: {session}, seq: {seq}"));
        print.add_recent(&self.node, LINK_TIMEOUT);
        print.set_now(self.now);
        for gateway in &self.gateways {
            let session = gateway.session.as_ref();
            let busy = session.is_some_and(|session| session.bus_needs().busy);
            print.add_session(&gateway.session, busy);
            print.add(&gateway.journal);
        }
        for lane in [&self.down, &self.up] {
            print.add(&(lane.cut, lane.stalled));
            print.add(&lane.queue);
            print.add(&lane.tape);
        }
        print.add(&self.held);
        let (truth, clients) = match print.is_exact() {
            true => (self.truth, self.clients),
            false => self.without_ends(),
        };
        print.add(&truth);
        print.add(&clients);
        print.add(&self.set_clients);
        print.add(&(self.plugged, self.boot, self.asked, self.acts, self.times));
        print.add_recent(&(self.holder, self.commanded), LINK_TIMEOUT + MOMENT);
    }

    /// What is still compared with what happens when a client knows the final state of its task: whether the task was
    /// rejected, and whether it has begun.
    fn without_ends(&self) -> (Truth, [Client; TASKS]) {
        let (mut truth, mut clients) = (self.truth, self.clients);
        for (execution, client) in truth.tasks.iter_mut().zip(&mut clients) {
            if !client.told.is_final() || client.own.own {
                continue;
            }
            execution.came_to = None;
            let told = match client.told {
                Told::Rejected => Told::Rejected,
                _ => Told::Ended(State::Completed),
            };
            *client = Client {
                told,
                gateway: client.gateway,
                ..Client::default()
            };
        }
        (truth, clients)
    }

    /// The next step while all faults last.
    fn go_on(&self) -> Action {
        if self.plugged {
            if self.down.brings() {
                return Action::Deliver(Way::Down);
            }
            let heard = self.gateways.iter().any(|g| g.session.is_some());
            if self.up.brings() && heard {
                return Action::Deliver(Way::Up);
            }
        }
        Action::Wait
    }
}

impl System for LinkModel {
    type Action = Action;

    fn calm(&self) -> Action {
        if let Some(dead) = self.gateways.iter().position(|g| g.session.is_none()) {
            return Action::Start(dead);
        }
        if !self.plugged {
            return Action::Plug;
        }
        for (way, lane) in [(Way::Down, &self.down), (Way::Up, &self.up)] {
            if lane.stalled || lane.cut {
                return Action::Mend(way);
            }
        }
        self.go_on()
    }

    fn disturbances(&self) -> Vec<Action> {
        let mut actions = Vec::new();
        // Lasting faults continue, unless that is the undisturbed step.
        let on = self.go_on();
        if on != self.calm() {
            actions.push(on);
        }
        if self.can_act() {
            actions.push(Action::Act);
        }
        for (gateway, place) in self.gateways.iter().enumerate() {
            if place.session.is_none() {
                actions.push(Action::Start(gateway));
            }
        }
        if !self.plugged {
            actions.push(Action::Plug);
        }
        for (way, lane) in [(Way::Down, &self.down), (Way::Up, &self.up)] {
            if lane.stalled || lane.cut {
                actions.push(Action::Mend(way));
            }
            if lane.tape.is_some() {
                actions.push(Action::Replay(way));
            }
        }
        actions.extend((0..self.held.len()).map(|place| Action::Release(place as u8)));
        if self.times > 0 {
            let faults = self.scenario.faults.iter().copied();
            actions.extend(faults.filter(|fault| self.can(*fault)).map(Action::Disturb));
        }
        let calm = self.calm();
        actions.retain(|action| *action != calm);
        actions
    }

    fn apply(&mut self, action: Action) -> Result<(), String> {
        match action {
            Action::Deliver(way) => {
                if let Some(parcel) = self.lane(way).queue.pop_front() {
                    self.deliver(way, &parcel)?;
                }
            }
            Action::Wait => self.now = self.wake(),
            Action::Act => {
                if let Some(act) = self.scenario.acts.get(self.acts) {
                    self.acts += 1;
                    self.note(|| format!("  {act:?}"));
                    self.act(*act)?;
                }
            }
            Action::Disturb(fault) => self.disturb(fault)?,
            Action::Release(place) => {
                let (way, parcel) = self.held.remove(usize::from(place));
                self.deliver(way, &parcel)?;
            }
            Action::Replay(way) => {
                for parcel in self.lane(way).tape.take().unwrap_or_default() {
                    self.deliver(way, &parcel)?;
                }
            }
            Action::Mend(way) => {
                let lane = self.lane(way);
                lane.stalled = false;
                lane.cut = false;
            }
            Action::Start(gateway) => {
                self.start(gateway);
                self.with_session(gateway, |_| {})?;
            }
            Action::Plug => {
                self.plugged = true;
                let now = self.now;
                for gateway in 0..self.gateways.len() {
                    self.with_session(gateway, |session| session.handle_connected(now))?;
                }
            }
        }
        self.settle()?;
        self.forget();
        self.judge()
    }

    fn fingerprint(&self) -> u64 {
        let mut print = self.fingerprinter();
        self.add_to(&mut print);
        print.finish()
    }

    fn exact(&self) -> u64 {
        let mut print = self.fingerprinter().exactly();
        self.add_to(&mut print);
        print.finish()
    }

    fn trace(&self, path: &[Action]) -> Vec<String> {
        let mut lab = self.clone();
        lab.notes = Some(Vec::new());
        for action in path {
            lab.note(|| format!("> {action:?}"));
            if let Err(promise) = lab.apply(*action) {
                lab.note(|| format!("BROKEN: {promise}"));
            }
        }
        lab.notes.unwrap_or_default()
    }

    fn settled(&self) -> Result<(), String> {
        let up = |gateway: &Gateway| gateway.session.as_ref().is_some_and(|s| s.is_up());
        if !self.gateways.iter().any(up) {
            return Err("promise 3: the device does not serve again".to_owned());
        }
        for (task, client) in self.clients.iter().enumerate().take(self.asked) {
            let moves = self.truth.moves(task);
            // Another gateway may hold the device for good.
            let holds = up(&self.gateways[client.gateway]);
            if client.own.own && !client.own.taken && client.told == Told::Nothing {
                self.judge_untaken(task)?;
                continue;
            }
            let open = !client.forgotten && !client.told.is_final() && holds;
            let endless = client.endless && !client.aborted;
            if open && endless && moves && client.told == Told::Accepted {
                continue;
            }
            if open {
                return Err(format!(
                    "promise 2: task {task} never ends; told {:?}",
                    client.told
                ));
            }
            if moves {
                return Err(format!("promise 4: task {task} moves for ever"));
            }
        }
        self.judge_settled_sets()
    }

    fn serves(&self) -> Result<(), String> {
        let mut lab = self.clone();
        let up = |gateway: &Gateway| gateway.session.as_ref().is_some_and(|s| s.is_up());
        let gateway = lab.gateways.iter().position(up).unwrap_or(0);
        let task = lab.asked;
        let Some(motor) = lab.truth.moving.iter().position(Option::is_none) else {
            return Ok(());
        };
        lab.act(Act::Ask {
            gateway,
            motor,
            millis: 30,
        })?;
        for _ in 0..100 {
            let calm = lab.calm();
            lab.apply(calm)?;
            match lab.clients[task].told {
                Told::Ended(State::Completed) => return Ok(()),
                told if told.is_final() => {
                    return Err(format!("promise 3: a new task is told {told:?}"));
                }
                _ => {}
            }
        }
        Err("promise 3: a new task does not end".to_owned())
    }
}
