//! Stops all robots.

use std::collections::BTreeSet;
use std::io;
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ztl_fleet::caller::{Caller, StopAnswer};
use ztl_fleet::config::EndpointConfig;
use ztl_fleet::session::ZenohError;
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
        let printer = Printer::start();
        let good = self.stop_and_tell(&printer);
        let printed = printer.end();
        let good = good?;
        printed?;
        Ok(code(good))
    }

    /// Returns whether every robot has confirmed that nothing runs.
    fn stop_and_tell(&self, printer: &Printer) -> Result<bool, ZenohError> {
        let groups = |caller: &Caller, agents: &Agents| self.groups(caller, agents);
        let (caller, all, config) = self.find_with(|text| printer.line(text), groups)?;
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
        let find_others = || self.stop_late(&caller, &config, missing.clone(), printer);
        let (now, late) = thread::scope(|threads| {
            let thread = thread::Builder::new().name("ztl-fleet-late".to_owned());
            let thread = thread.spawn_scoped(threads, find_others);
            let now = stop(&caller, &there, printer);
            // A thread that panics ends the process.
            let late = thread.map(|thread| thread.join().unwrap_or(false));
            (now, late.unwrap_or_else(|_| find_others()))
        });
        if config.robots.is_empty() {
            printer.line(
                "others  unknown: the file names no 'robots', so nobody can tell which are not there".to_owned(),
            );
        }
        Ok(now && late && !config.robots.is_empty())
    }

    /// What agents say of their groups, if that matters. Otherwise no robot waits for what another one says.
    fn groups(&self, caller: &Caller, agents: &Agents) -> Vec<Option<RobotInfo>> {
        match self.group {
            None => vec![None; agents.len()],
            Some(_) => caller.infos(agents, LIMIT),
        }
    }

    /// Stops robots that were not there, as soon as they are. Returns whether all have confirmed.
    fn stop_late(
        &self,
        caller: &Caller,
        config: &EndpointConfig,
        mut missing: BTreeSet<String>,
        printer: &Printer,
    ) -> bool {
        let mut good = true;
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
            good &= stop(caller, &found, printer);
        }
        for name in &missing {
            printer.line(format!("{name}  was not there"));
        }
        good && missing.is_empty()
    }
}

/// Prints on a thread of its own: a terminal that is held, or a pipe that nobody reads, keeps no robot from being stopped.
struct Printer {
    lines: Sender<String>,
    /// `None` if the system has no thread for it.
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl Printer {
    fn start() -> Self {
        let (lines, to_print) = channel::<String>();
        let thread = thread::Builder::new().name("ztl-fleet-print".to_owned());
        let thread = thread.spawn(move || to_print.into_iter().try_for_each(line));
        let thread = thread.ok();
        Self { lines, thread }
    }

    fn line(&self, text: String) {
        if let Err(unsent) = self.lines.send(text) {
            // There is no thread that prints, or its output is closed.
            let _ = line(unsent.0);
        }
    }

    /// Waits until all is printed.
    fn end(self) -> io::Result<()> {
        drop(self.lines);
        // A thread that panics ends the process.
        let ended = self.thread.and_then(|thread| thread.join().ok());
        ended.unwrap_or(Ok(()))
    }
}

/// Stops robots, and prints what each of them says. Returns whether all have confirmed.
fn stop(caller: &Caller, agents: &Agents, printer: &Printer) -> bool {
    let mut good = true;
    caller.stop_all(agents, STOPPING, |index, answer| {
        let name = agents.get(index).map_or("", |(name, _)| name);
        let (has_confirmed, said) = stopped(answer);
        good &= has_confirmed;
        printer.line(format!("{name}  {said}"));
    });
    good
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
