//! Begins and ends the happenings of a plan.

use std::time::Duration;

use ztl_core::Instant;
use ztl_sim::line::Faults;

use super::Lab;
use super::gateway::Gateway;
use crate::plan::{Revert, Trouble, Way, What};

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
                for device in self.of_line(device) {
                    self.devices[device].unplug(now);
                    if let Some(gateway) = &mut self.gateway {
                        gateway.sessions[device].handle_disconnected();
                    }
                }
                if let Some(line) = &mut self.line {
                    line.close();
                }
                self.reverts.push((now + time, Revert::Plug(device)));
            }
            What::Trouble(device, trouble, time) => self.trouble(device, trouble, time),
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
                    if let Some(line) = &mut self.line {
                        line.abandon();
                    }
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
        let devices = (self.devices.len(), self.line.is_some());
        let mut gateway = Gateway::new(self.now, devices, self.disk.as_ref(), self.boots);
        if let Some(line) = &mut self.line {
            line.open(self.now);
        }
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
                Revert::Plug(device) => self.plug(device),
                Revert::Healthy(device) => self.devices[device].set_trouble(None),
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

    /// The devices on the same line.
    fn of_line(&self, device: usize) -> std::ops::Range<usize> {
        match self.line {
            Some(_) => 0..self.devices.len(),
            None => device..device + 1,
        }
    }

    fn plug(&mut self, device: usize) {
        for device in self.of_line(device) {
            if self.devices[device].plug()
                && let Some(gateway) = &mut self.gateway
            {
                gateway.sessions[device].handle_connected(self.now);
            }
        }
        if self.devices[device].is_plugged()
            && let Some(line) = &mut self.line
        {
            line.open(self.now);
        }
    }

    pub(super) fn trouble(&mut self, device: usize, trouble: Trouble, time: Duration) {
        let (now, device_of) = (self.now, &mut self.devices[device]);
        match trouble {
            Trouble::Silent => {
                device_of.cut(Way::Down, now..now + time);
                device_of.cut(Way::Up, now..now + time);
            }
            Trouble::Mute => device_of.cut(Way::Up, now..now + time),
            trouble => {
                device_of.set_trouble(Some((trouble, now)));
                self.reverts.push((now + time, Revert::Healthy(device)));
            }
        }
    }
}
