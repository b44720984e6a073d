//! Parameters that clients set: what they are told, and what really happened.

use super::ends::link::{
    LinkEvent, ParameterAnswer, ParameterFailure, ParameterRequest, ParameterValue,
};
use super::ends::mcu::parameters::{Declaration, Parameter, Tunable, Value};
use super::link::LinkModel;
use super::motor::{Motor, TRUTH};

/// Maximum number of values that a scenario sets.
pub(super) const SETS: usize = 2;

/// What the client of a value is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum SetTold {
    /// It has not asked.
    #[default]
    Unasked,
    /// Nothing yet.
    Nothing,
    /// It is set.
    Set,
    /// It is not set and never will be.
    NotSet,
    /// It may be set or not.
    Unknown,
}

/// A value that a client sets. The first value is 1, the next one 2.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SetClient {
    pub(super) told: SetTold,
    pub(super) gateway: usize,
}

impl Tunable for Motor {
    const PARAMETERS: &'static [Declaration] = &[Parameter::<u32>::new(0).declare("value")];

    fn value(&self, _: usize) -> Option<Value<'_>> {
        Some(Value::U32(self.value))
    }

    fn set(&mut self, _: usize, value: Value<'_>) {
        let Value::U32(number) = value else { return };
        self.value = number;
        TRUTH.with_borrow_mut(|truth| {
            truth.set_under_task |= truth.moving[self.place].is_some();
            if let Some(times) = truth.sets.get_mut(number as usize - 1) {
                *times += 1;
            }
        });
    }
}

impl LinkModel {
    /// A client sets the next value at a motor.
    pub(super) fn set(&mut self, gateway: usize, motor: usize) -> Result<(), String> {
        let place = self
            .set_clients
            .iter()
            .position(|it| it.told == SetTold::Unasked);
        let place = place.ok_or("the scenario sets too many values")?;
        self.set_clients[place] = SetClient {
            told: SetTold::Nothing,
            gateway,
        };
        let now = self.now;
        let number = place as u32 + 1;
        let request = ParameterRequest::Set(motor as u8, ParameterValue::U32(number));
        self.with_session(gateway, |session| {
            session.request_parameter(now, number.into(), request);
        })
    }

    /// A client is told what became of its value.
    pub(super) fn on_set_answer(&mut self, event: &LinkEvent) -> Result<(), String> {
        let LinkEvent::Parameter(number, answer) = event else {
            return Ok(());
        };
        let told = match answer {
            ParameterAnswer::Ok(Some(info))
                if info.value == ParameterValue::U32(*number as u32) =>
            {
                SetTold::Set
            }
            ParameterAnswer::Ok(info) => {
                return Err(format!("promise 8: value {number} is told as {info:?}"));
            }
            ParameterAnswer::Err(ParameterFailure::Unknown) => SetTold::Unknown,
            ParameterAnswer::Err(_) => SetTold::NotSet,
        };
        let client = &mut self.set_clients[*number as usize - 1];
        if client.told != SetTold::Nothing {
            return Err(format!("promise 8: value {number} is told twice"));
        }
        client.told = told;
        Ok(())
    }

    /// The gateway is killed: its clients learn nothing more.
    pub(super) fn lose_sets(&mut self, gateway: usize) {
        for client in &mut self.set_clients {
            if client.gateway == gateway && client.told == SetTold::Nothing {
                client.told = SetTold::Unknown;
            }
        }
    }

    /// Checks what must hold at any time.
    pub(super) fn judge_sets(&self) -> Result<(), String> {
        if self.truth.set_under_task {
            return Err("promise 8: a value is set under a task".to_owned());
        }
        for (place, (client, times)) in self.set_clients.iter().zip(self.truth.sets).enumerate() {
            let right = match client.told {
                SetTold::Set => times == 1,
                SetTold::Unasked | SetTold::NotSet => times == 0,
                SetTold::Nothing | SetTold::Unknown => times <= 1,
            };
            if !right {
                let (number, told) = (place + 1, client.told);
                return Err(format!(
                    "promise 8: value {number} is told {told:?}, but was set {times} times"
                ));
            }
        }
        Ok(())
    }

    /// Checks that each client is told something, when there has been time to.
    pub(super) fn judge_settled_sets(&self) -> Result<(), String> {
        let open = |client: &SetClient| client.told == SetTold::Nothing;
        match self.set_clients.iter().any(open) {
            true => Err("promise 8: the client of a value is told nothing".to_owned()),
            false => Ok(()),
        }
    }
}
