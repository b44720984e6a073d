//! Begins and ends the happenings of a plan.

use ztl_core::Instant;
use ztl_sim::line::Faults;

use super::Lab;
use super::gateway::Gateway;
use crate::plan::{Revert, What};

impl Lab {
    pub(super) fn happen(&mut self, what: What) {
        let now = self.now;
        match what {
            What::Ask {
                client,
                device,
                motor,
                millis,
                to_end,
            } => {
                self.ask(client, device, motor, millis, to_end);
            }
            What::Abort { client, task } => {
                if let Some(id) = self.books.id(task) {
                    self.people[client].abort(task, id);
                }
            }
            What::Press {
                device,
                motor,
                millis,
            } => self.press(device, motor, millis),
            What::Reset(device) => self.devices[device].reset(now),
            What::Unplug(device, time) => {
                self.devices[device].unplug();
                if let Some(gateway) = &mut self.gateway {
                    gateway.sessions[device].handle_disconnected();
                }
                self.reverts.push((now + time, Revert::Plug(device)));
            }
            What::Cut(device, way, time) => self.devices[device].cut(way, now..now + time),
            What::Stall(device, way, time) => {
                self.devices[device].way(way).hold_until(now + time);
            }
            What::Noise(device, way, faults, time) => {
                self.devices[device].way(way).set_faults(faults);
                self.reverts
                    .push((now + time, Revert::Silence(device, way)));
            }
            What::Kill(torn, time) => {
                if self.gateway.take().is_some() {
                    if let Some(disk) = &self.disk {
                        // An incomplete entry.
                        let entry = b"{\"event\":\"start\",\"task\":1";
                        disk.tear(entry.get(..torn).unwrap_or(entry));
                    }
                    self.books.killed();
                    self.able_since = Instant::NEVER;
                    self.to_gateway.clear();
                    self.to_people.clear();
                    self.reverts.push((now + time, Revert::Start));
                }
            }
            What::Full(time) => {
                if let Some(disk) = &self.disk {
                    disk.set_full(true);
                    self.able_since = Instant::NEVER;
                    self.reverts.push((now + time, Revert::Empty));
                }
            }
            What::Deaf(time) => self.deaf_until = self.deaf_until.max(now + time),
        }
    }

    pub(super) fn start_gateway(&mut self) {
        self.boots += 1;
        let mut gateway =
            Gateway::new(self.now, self.devices.len(), self.disk.as_ref(), self.boots);
        for (device, session) in self.devices.iter().zip(&mut gateway.sessions) {
            if device.is_plugged() {
                session.handle_connected(self.now);
            }
        }
        self.gateway = Some(gateway);
        self.able_since = self.now;
        let boots = self.boots;
        self.note(|| format!("the gateway is started, number {boots}"));
    }

    pub(super) fn revert(&mut self) {
        let now = self.now;
        while let Some(place) = self.reverts.iter().position(|(at, _)| *at <= now) {
            let (_, revert) = self.reverts.remove(place);
            self.note(|| format!("> over: {revert:?}"));
            match revert {
                Revert::Plug(device) => {
                    if self.devices[device].plug()
                        && let Some(gateway) = &mut self.gateway
                    {
                        gateway.sessions[device].handle_connected(now);
                    }
                }
                Revert::Silence(device, way) => {
                    self.devices[device].way(way).set_faults(Faults::default());
                }
                Revert::Start => self.start_gateway(),
                Revert::Empty => {
                    if let Some(disk) = &self.disk {
                        disk.set_full(false);
                    }
                    self.able_since = now;
                }
            }
        }
    }
}
