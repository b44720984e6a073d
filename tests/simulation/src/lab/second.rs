//! A second board at the address of a device on a shared line (`docs/link.md`, 15.8).

use std::rc::Rc;
use std::time::Duration;

use ztl_core::State;
use ztl_core::link::Loss;

use super::Lab;
use super::device::Device;
use super::gateway::address;
use super::some_node::{Place, second_id};
use crate::plan::{Dice, Plan, Way};

/// How long one of the boards cannot be heard: longer than four searches.
const AWAY: Duration = Duration::from_secs(14);
/// Until a task has begun.
const BEGIN: Duration = Duration::from_millis(500);
/// How long its tasks take: the first one ends while the second board has one.
const LONG: u64 = 20_000;
/// Until the device serves again.
const TOLD: Duration = Duration::from_secs(4);

impl Lab {
    /// The wires of a device break while it carries out a task, and another board gets its address; that one is given a task as
    /// well. Then each can be heard in turn. Both tasks come to their goal, and neither has another end before.
    pub(super) fn serve_second(&mut self, plan: &Plan) -> Result<(), String> {
        let carries_on = plan
            .devices
            .iter()
            .enumerate()
            .find_map(|(device, motors)| {
                let motor = motors
                    .iter()
                    .position(|motor| motor.loss == Loss::CarryOn)?;
                Some((device, motor))
            });
        let Some((device, motor)) = carries_on else {
            return Ok(());
        };
        self.note(|| format!("from now on device {device} has a second board"));
        let first = self.ask(0, device, motor, LONG, false);
        self.pass_until(self.now + BEGIN)?;
        let address = address(device);
        let place = Place {
            address,
            id: second_id(address),
        };
        let number = self.devices.len();
        let truth = Rc::clone(&self.truth);
        let seed = Dice::new(plan.seed ^ number as u64).throw();
        let motors = plan.devices[device];
        let second = Device::new(self.now, seed, (number, Some(place)), motors, truth);
        self.second = Some(second);
        let cut = |device: Option<&mut Device>, now| {
            let device = device.ok_or("it is there")?;
            for way in [Way::Down, Way::Up] {
                device.cut(way, now..now + AWAY);
            }
            Ok::<_, String>(())
        };
        cut(self.devices.get_mut(device), self.now)?;
        self.pass_until(self.now + (AWAY - BEGIN))?;
        let other = self.ask(0, device, motor, LONG, false);
        self.pass_until(self.now + BEGIN)?;
        if self.truth.borrow().motors[number][motor].task != Some(other) {
            return Err("promise 3: the second board does not serve".to_owned());
        }
        cut(self.second.as_mut(), self.now)?;
        self.pass_until(self.now + AWAY)?;
        self.books.came_to(first, State::Completed)?;
        cut(self.devices.get_mut(device), self.now)?;
        self.pass_until(self.now + AWAY)?;
        self.second = None;
        self.pass_until(self.now + TOLD)?;
        self.books.came_to(other, State::Completed)?;
        self.serve_one(device, motor)
    }
}
