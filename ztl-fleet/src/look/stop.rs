//! Stops all robots.

use std::collections::BTreeSet;
use std::io;
use std::thread;
use std::time::{Duration, Instant};

use ztl_fleet::caller::{Caller, StopAnswer};
use ztl_fleet::config::EndpointConfig;
use ztl_fleet::wire::{RobotInfo, Stopped};

use super::{Agents, Found, LIMIT, STOPPING, Select, code};
use crate::{Done, line};

/// How long robots of the file that are not there are looked for: a router that has just started does not know all of them.
const LATE: Duration = Duration::from_secs(3);
/// Pause between two looks.
const AGAIN: Duration = Duration::from_millis(200);

impl Select {
    /// Exit code 0 if every robot has confirmed that nothing runs.
    pub(crate) fn stop_all(self) -> Done {
        let (caller, all, config) = self.find_with(|caller, agents| self.groups(caller, agents))?;
        if all.is_empty() {
            return Err("no robot is there, so none was stopped".into());
        }
        let (mut there, mut missing) = (Agents::new(), BTreeSet::new());
        for found in all {
            match found.agent {
                Some((agent, _)) => there.push((found.name, agent)),
                None => drop(missing.insert(found.name)),
            }
        }
        let find_others = || self.stop_late(&caller, &config, missing.clone());
        let (now, late) = thread::scope(|threads| {
            let thread = thread::Builder::new().name("ztl-fleet-late".to_owned());
            let thread = thread.spawn_scoped(threads, find_others);
            let now = stop(&caller, &there);
            // A thread that panics ends the process.
            let late = thread.map(|thread| thread.join().unwrap_or(Ok(false)));
            (now, late.unwrap_or_else(|_| find_others()))
        });
        let mut good = now? & late?;
        if config.robots.is_empty() {
            good = false;
            line(
                "others  unknown: the file names no 'robots', so nobody can tell which are not there",
            )?;
        }
        Ok(code(good))
    }

    /// What agents say of their groups, if that matters. Otherwise no robot waits for what another one says.
    fn groups(&self, caller: &Caller, agents: &Agents) -> Vec<Option<RobotInfo>> {
        match self.group {
            None => vec![None; agents.len()],
            Some(_) => caller.infos(agents, LIMIT),
        }
    }

    /// Stops robots that were not there, as soon as they are.
    fn stop_late(
        &self,
        caller: &Caller,
        config: &EndpointConfig,
        mut missing: BTreeSet<String>,
    ) -> io::Result<bool> {
        let (mut good, mut printed) = (true, Ok(()));
        let end = Instant::now() + LATE;
        while !missing.is_empty() && Instant::now() < end {
            thread::sleep(AGAIN);
            let looked =
                self.look_with(caller, config, |caller, agents| self.groups(caller, agents));
            // Without an answer, the routers are asked again.
            let Ok(looked) = looked else { continue };
            // One that is in another group is not listed.
            missing.retain(|name| looked.found.iter().any(|found| found.name == *name));
            let mut found = Agents::new();
            for Found { name, agent, .. } in looked.found {
                if let Some((agent, _)) = agent
                    && missing.remove(&name)
                {
                    found.push((name, agent));
                }
            }
            match stop(caller, &found) {
                Ok(confirmed) => good &= confirmed,
                Err(error) => printed = Err(error),
            }
        }
        printed?;
        for name in &missing {
            line(format_args!("{name}  was not there"))?;
        }
        Ok(good && missing.is_empty())
    }
}

/// Stops robots, and prints what each of them says. Returns whether all have confirmed.
fn stop(caller: &Caller, agents: &Agents) -> io::Result<bool> {
    let (mut good, mut printed) = (true, Ok(()));
    caller.stop_all(agents, STOPPING, |index, answer| {
        let name = agents.get(index).map_or("", |(name, _)| name);
        let (has_confirmed, said) = stopped(answer);
        good &= has_confirmed;
        // The others are stopped also if nobody reads this.
        if let Err(error) = line(format_args!("{name}  {said}")) {
            printed = Err(error);
        }
    });
    printed.map(|()| good)
}

/// Whether a robot has confirmed that nothing runs, and what it said.
fn stopped(answer: StopAnswer) -> (bool, String) {
    let of = |told: &Stopped| match (&told.running[..], &told.unknown) {
        ([], None) => (true, format!("stopped: {} tasks", told.stopped.len())),
        ([], Some(why)) => (false, format!("not confirmed: {why}")),
        (running, None) => (false, format!("still running: {}", running.join(", "))),
        (running, Some(why)) => (
            false,
            format!("still running: {}; {why}", running.join(", ")),
        ),
    };
    let each = |machines: &[Stopped]| {
        let all = machines.iter().map(|told| of(told).1);
        all.collect::<Vec<_>>().join("; ")
    };
    let reason = answer
        .reason
        .unwrap_or_else(|| "it did not confirm".to_owned());
    match &answer.machines[..] {
        [] if answer.is_refused => (false, format!("refused: {reason}")),
        [] if answer.misses_one => (false, format!("not confirmed: {reason}")),
        [] => (false, format!("not reached: {reason}")),
        [told] if !answer.misses_one => of(told),
        [told] => (
            false,
            format!(
                "not confirmed: an answer is missing, of this machine or of another one with its name and id; it said: {}",
                of(told).1
            ),
        ),
        machines => (
            false,
            format!(
                "not confirmed: {} machines have its name and id, and there may be more; {}",
                machines.len(),
                each(machines)
            ),
        ),
    }
}
