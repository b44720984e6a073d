//! The robots that an endpoint knows.

use std::collections::BTreeSet;

use ztl_core::Instant;

use super::{Endpoint, EndpointEffect, RobotInfo};
use crate::wire::millis;

/// Most robots that are known.
const MOST_ROBOTS: usize = 10_000;
/// Most other agents of a name that are known.
const MOST_RIVALS: usize = 16;

/// A robot that is or was there.
#[derive(Debug)]
pub(super) struct Robot {
    /// Its agent, while it is there.
    pub(super) agent: Option<String>,
    /// Other agents that claim the name.
    rivals: BTreeSet<String>,
    /// Whether two machines answer as its agent.
    pub(super) is_doubted: bool,
    /// What it last said.
    pub(super) info: Option<RobotInfo>,
    /// The agent's boot id and its clock in milliseconds, and when that was heard.
    clock: (u32, u64, Instant),
}

impl Robot {
    /// The boot id of its agent, and what the agent's clock shows at least; zeros if that is not known.
    pub(super) fn clock(&self, now: Instant) -> (u32, u64) {
        let (boot, clock_ms, heard) = self.clock;
        // A request may have arrived before the clock was heard, and waited for its turn.
        let then = clock_ms.saturating_sub(millis(heard.since(now)));
        (boot, then.saturating_add(millis(now.since(heard))))
    }
}

impl Endpoint {
    /// An agent is there.
    pub fn handle_alive(&mut self, robot: &str, agent: &str) -> Vec<EndpointEffect> {
        if self.robots.len() >= MOST_ROBOTS && !self.robots.contains_key(robot) {
            // Anybody may claim names.
            return Vec::new();
        }
        let known = self
            .robots
            .entry(robot.to_owned())
            .or_insert_with(|| Robot {
                agent: None,
                rivals: BTreeSet::new(),
                is_doubted: false,
                info: None,
                clock: (0, 0, Instant::ZERO),
            });
        match &known.agent {
            Some(served) if served == agent => Vec::new(),
            Some(served) => {
                if known.rivals.len() < MOST_RIVALS {
                    known.rivals.insert(agent.to_owned());
                }
                vec![EndpointEffect::Rivals {
                    robot: robot.to_owned(),
                    agent: served.clone(),
                    rival: agent.to_owned(),
                }]
            }
            None => {
                known.agent = Some(agent.to_owned());
                // The agent may have been restarted.
                known.clock = (0, 0, Instant::ZERO);
                vec![EndpointEffect::AskInfo {
                    robot: robot.to_owned(),
                    agent: agent.to_owned(),
                }]
            }
        }
    }

    /// An agent is gone, or not reached any more.
    pub fn handle_gone(&mut self, robot: &str, agent: &str) -> Vec<EndpointEffect> {
        let Some(known) = self.robots.get_mut(robot) else {
            return Vec::new();
        };
        if known.agent.as_deref() != Some(agent) {
            known.rivals.remove(agent);
            return Vec::new();
        }
        known.agent = None;
        match known.rivals.pop_first() {
            Some(rival) => self.handle_alive(robot, &rival),
            None => {
                // Who has never said what it is may have been anybody.
                if known.info.is_none() {
                    self.robots.remove(robot);
                }
                Vec::new()
            }
        }
    }

    /// What an agent says of its robot.
    pub fn handle_info(&mut self, now: Instant, robot: &str, agent: &str, mut info: RobotInfo) {
        // Behind the robot's name, another text could name another robot.
        info.scopes.retain(|scope| scope.starts_with('/'));
        self.on_clock(now, robot, agent, info.boot, info.clock_ms);
        if let Some(known) = self.robots.get_mut(robot)
            && known.agent.as_deref() == Some(agent)
        {
            known.info = Some(info);
        }
    }

    /// Robots that belong to the fleet, whether or not they are there.
    pub fn expect(&mut self, robots: impl IntoIterator<Item = String>) {
        self.expected.extend(robots);
    }

    /// Whether two machines answer as a robot's agent: INITs are refused then.
    pub fn handle_doubt(&mut self, robot: &str, is_doubted: bool) {
        if let Some(known) = self.robots.get_mut(robot) {
            known.is_doubted = is_doubted;
        }
    }

    /// The boot id of a robot's agent, and what the agent's clock shows at least, in milliseconds; zeros if that is not known.
    #[must_use]
    pub fn clock(&self, now: Instant, robot: &str) -> (u32, u64) {
        let robot = self.robots.get(robot);
        robot.map_or((0, 0), |robot| robot.clock(now))
    }

    /// The agent of a robot that is served, if it is there.
    #[must_use]
    pub fn served(&self, robot: &str) -> Option<&str> {
        self.robots.get(robot)?.agent.as_deref()
    }

    /// The agents that are there.
    pub fn robots(&self) -> impl Iterator<Item = (&str, &str)> {
        let robots = self.robots.iter();
        robots.filter_map(|(name, robot)| Some((name.as_str(), robot.agent.as_deref()?)))
    }

    pub(super) fn on_clock(
        &mut self,
        now: Instant,
        robot: &str,
        agent: &str,
        boot: u32,
        clock_ms: u64,
    ) {
        if let Some(known) = self.robots.get_mut(robot)
            && known.agent.as_deref() == Some(agent)
        {
            known.clock = (boot, clock_ms, now);
        }
    }
}
