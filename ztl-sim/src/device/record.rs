//! A record of what a simulated device really did, independent of node and gateway.

use std::fs::File;
use std::io::Write;
use std::sync::{Arc, Mutex, PoisonError};

use ztl_core::repr::put_quoted;
use ztl_mcu::link::Offer;
use ztl_mcu::parameters::{Declaration, Tunable, Value};
use ztl_mcu::{Component, Instant, Reading, Refused, Report, Run};

use ztl_std::time::now;

/// A file that receives a line for each event.
#[derive(Debug, Clone)]
pub(super) struct Record {
    file: Arc<Mutex<File>>,
    /// Before the name of each component.
    prefix: String,
}

impl Record {
    pub(super) fn new(file: File) -> Self {
        Self {
            file: Arc::new(Mutex::new(file)),
            prefix: String::new(),
        }
    }

    /// The same record, for a node with this name.
    pub(super) fn of(&self, node: &str) -> Self {
        Self {
            file: Arc::clone(&self.file),
            prefix: format!("{node}."),
        }
    }

    /// Writes `12.345678 finger begins '40'`, with the time in seconds since this process started.
    pub(super) fn write(&self, component: &str, what: &str, goal: &str) {
        let time = now().as_micros();
        let mut line = format!(
            "{}.{:06} {}{component} {what} ",
            time / 1_000_000,
            time % 1_000_000,
            self.prefix
        )
        .into_bytes();
        put_quoted(goal, &mut |bytes: &[u8]| line.extend_from_slice(bytes));
        line.push(b'\n');
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(error) = file.write_all(&line) {
            // Otherwise it would look as if nothing had happened.
            tracing::error!("the device record is incomplete: {error}");
        }
    }
}

/// A component whose tasks are recorded.
#[derive(Debug)]
pub(super) struct Recorded<C> {
    component: C,
    record: Option<Record>,
    /// The goal of the running task.
    goal: Option<String>,
}

impl<C: Component> Recorded<C> {
    pub(super) fn new(component: C, record: Option<Record>) -> Self {
        Self {
            component,
            record,
            goal: None,
        }
    }

    fn write(&self, what: &str, goal: &str) {
        if let Some(record) = &self.record {
            record.write(self.component.offer().name, what, goal);
        }
    }

    fn end(&mut self, what: &str) {
        if let Some(goal) = self.goal.take() {
            self.write(what, &goal);
        }
    }
}

/// Forwards every method. Add new methods of the trait here.
#[warn(clippy::missing_trait_methods)]
impl<C: Tunable> Tunable for Recorded<C> {
    const PARAMETERS: &'static [Declaration] = C::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.component.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.component.set(index, value);
    }
}

impl<C: Component> Component for Recorded<C> {
    fn offer(&self) -> Offer<'_> {
        self.component.offer()
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.component.check(goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.component.start(now, goal, why)?;
        self.write("begins", goal);
        self.goal = Some(goal.to_owned());
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let run = self.component.poll(now, report);
        match run {
            Run::Running => {}
            Run::Completed => self.end("completed"),
            Run::Failed => self.end("failed"),
            Run::Aborted => self.end("aborted"),
        }
        run
    }

    fn abort(&mut self, now: Instant) {
        self.component.abort(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.component.make_safe(now);
        self.end("made-safe");
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        self.component.poll_timeout(now)
    }

    fn next_tick(&self) -> Instant {
        self.component.next_tick()
    }

    fn result(&self) -> &str {
        self.component.result()
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        self.component.poll_reading(now, buffer)
    }
}
