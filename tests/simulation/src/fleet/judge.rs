//! What was true, and what clients were told.

use ztl_core::{Message, State};

/// An INIT of a client.
#[derive(Debug, Clone, Default)]
pub(super) struct Truth {
    /// How often it acted.
    pub(super) starts: u32,
    pub(super) robot: usize,
    pub(super) server: u32,
    pub(super) id: u32,
    pub(super) state: Option<State>,
    /// Somebody was told that it did not act and will not.
    pub(super) dead: Option<String>,
    /// The id that was told.
    pub(super) told: Option<u32>,
}

/// What an answer says of an INIT.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Said {
    Task(u32),
    Nothing,
    Unknown,
}

/// Reads the answer to an INIT, or to `outcome` of an endpoint with this boot id.
pub(super) fn read(body: &[u8], boot: u32) -> Said {
    let Ok(message) = Message::parse(body) else {
        return Said::Unknown;
    };
    let id = message.id.parse::<u32>().ok().filter(|id| *id > 0);
    match (message.state, id) {
        // An INIT that is not the client's last one any more was given up by the client itself.
        ("2", _) if message.payload.contains("settled") => Said::Unknown,
        ("2", _) if message.id == "0" => {
            let never = format!("never seen since boot {boot}");
            match message.payload == never {
                true => Said::Nothing,
                false => Said::Unknown,
            }
        }
        ("2", _) if message.scope == "$ztl" && message.payload.starts_with("Invalid") => {
            Said::Unknown
        }
        ("2", _) => Said::Nothing,
        (_, Some(id)) => Said::Task(id),
        _ => Said::Unknown,
    }
}

impl Truth {
    /// A task of this INIT acts.
    pub(super) fn start(&mut self, robot: usize, server: u32, id: u32) -> Result<(), String> {
        self.starts += 1;
        if self.starts > 1 {
            return Err("an INIT acted twice".to_owned());
        }
        if let Some(why) = &self.dead {
            return Err(format!("an INIT acted after it was told not to: {why}"));
        }
        if let Some(told) = self.told.filter(|told| *told != id) {
            return Err(format!(
                "another id was told before the start: {told} instead of {id}"
            ));
        }
        (self.robot, self.server, self.id) = (robot, server, id);
        self.state = Some(State::Accepted);
        Ok(())
    }

    /// Somebody is told this of the INIT.
    pub(super) fn tell(&mut self, said: Said, body: &[u8]) -> Result<(), String> {
        let text = String::from_utf8_lossy(body).into_owned();
        match said {
            Said::Unknown => Ok(()),
            Said::Nothing if self.starts > 0 => {
                Err(format!("a rejection is told of an INIT that acted: {text}"))
            }
            Said::Nothing => {
                self.dead = Some(text);
                Ok(())
            }
            Said::Task(id) => {
                let known = if self.starts > 0 {
                    Some(self.id)
                } else {
                    self.told
                };
                self.told = Some(id);
                match known {
                    Some(known) if known != id => {
                        Err(format!("another id is told: {text} instead of {known}"))
                    }
                    _ => self.status(body, false),
                }
            }
        }
    }

    /// Somebody is told this state of its task.
    pub(super) fn status(&self, body: &[u8], same_server: bool) -> Result<(), String> {
        let Ok(message) = Message::parse(body) else {
            return Err("an answer that cannot be read".to_owned());
        };
        let text = String::from_utf8_lossy(body);
        let told = [State::Failed, State::Aborted, State::Completed]
            .into_iter()
            .find(|state| message.state == state.code().to_string());
        match told {
            Some(told) if self.state != Some(told) => {
                Err(format!("a false final state is told: {text}"))
            }
            None if message.state == "2" && same_server && self.starts > 0 => {
                Err(format!("a task that acted is denied: {text}"))
            }
            _ => Ok(()),
        }
    }
}
