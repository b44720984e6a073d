//! Programs as handlers: scripts and command-line tools.

pub(crate) mod assignment;
pub(crate) mod ignored;
mod launch;
mod output;
mod process_group;
pub(crate) mod processes;
pub(crate) mod read;
mod run;
pub(crate) mod settings;
pub(crate) mod template;
pub(crate) mod watchdog;

use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::process::{ChildStderr, ChildStdout, ExitStatus};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::io::ioctl_fionbio;
use rustix::process::Signal;
use tracing::{debug, warn};

use crate::call::Call;
use crate::human::human_time;
use crate::kind::{
    CANNOT_ABORT, Effect, Job, JobContext, JobEvent, Kind, Outcome, STOP_TIME, Services, Start,
    StopReason,
};
use crate::log::LOG;
use assignment::Assignment;
use launch::Launch;
use processes::{Announcement, Process, ProcessRegistry};
use run::{Action, Run};
use settings::{AbortBy, Program, ResultKind};
use watchdog::protocol::{Charge, Ending};

/// How long the watchdog may take to confirm that it knows of a program. Less than the 1.5 s after which the
/// server answers an INIT with an id.
const CONFIRM: Duration = Duration::from_millis(1200);
/// Most bytes that are read of a pipe at a time, so that other programs get their turn.
const READ: usize = 16 * 1024;
/// The same for a stream, whose frames may be very short, so that the turns of others come soon.
const STREAM_READ: usize = 4 * 1024;
/// Most reads after a program's end, because processes that it left behind may keep writing.
const LAST_READS: usize = 64;

impl Kind for Program {
    fn at_once(&self) -> usize {
        1
    }

    fn needs_fields(&self) -> bool {
        let abort = match &self.abort.by {
            AbortBy::Program(run) => run.arguments.as_slice(),
            AbortBy::Signal(..) => &[],
        };
        let mut arguments = self.run.arguments.iter().chain(abort);
        arguments.any(|argument| argument.template.has_fields())
    }

    fn can_abort(&self) -> bool {
        self.abort.allowed
    }

    fn stop_time(&self) -> Duration {
        self.abort.grace + STOP_TIME
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.run.launch(call).map(drop)
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, services: &Services) -> Start {
        match Assignment::of_task(&self, &call) {
            Ok(assignment) => {
                let job = ProgramJob::new(self, assignment, task, &services.processes);
                Start::Running(Box::new(job))
            }
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

/// A program that runs for a task or a stream.
pub(crate) struct ProgramJob {
    program: Arc<Program>,
    processes: ProcessRegistry,
    context: JobContext,
    name: String,
    /// `ZTL_ID`
    id: String,
    /// What stops it, if a program does.
    abort: Option<Result<Launch, String>>,
    state: State,
}

enum State {
    /// The watchdog is to confirm that it knows of the program.
    Announced {
        announcement: Announcement,
        launch: Launch,
        /// When the task is rejected instead.
        until: Option<Instant>,
    },
    /// A thread starts the program. Stops it then for this reason.
    Starting(Option<StopReason>),
    Running(Box<Running>),
    Ended,
}

struct Running {
    run: Run,
    process: Process,
    out: Option<ChildStdout>,
    err: Option<ChildStderr>,
    /// Whether the first process has ended.
    ended: bool,
}

impl Job for ProgramJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        let mut actions = Vec::new();
        match &mut self.state {
            State::Announced { .. } => effects.push(Effect::End(why.before_start())),
            State::Starting(stop) => *stop = stop.or(Some(why)),
            State::Running(_) if why == StopReason::Client && !self.program.abort.allowed => {
                effects.push(Effect::RejectAbort(CANNOT_ABORT.to_owned()));
            }
            State::Running(running) => running.run.stop(now, why, &mut actions),
            State::Ended => {}
        }
        self.act(actions, effects);
    }

    fn handle_event(&mut self, now: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        match event {
            JobEvent::Confirmed => self.on_confirmed(now, effects),
            JobEvent::Started(Ok(process)) => self.on_started(now, process, effects),
            JobEvent::Started(Err(reason)) => effects.push(Effect::End(Outcome::Rejected(reason))),
            JobEvent::AbortNotStarted(reason) => self.on_abort_not_started(&reason),
            JobEvent::Ros1(_) | JobEvent::Naoqi(_) => {}
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.state {
            State::Announced { until, .. } => *until,
            State::Running(running) => running.run.poll_timeout(),
            State::Starting(_) | State::Ended => None,
        }
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        let mut actions = Vec::new();
        match &mut self.state {
            State::Announced { until, .. } if until.is_some_and(|until| until <= now) => {
                effects.push(Effect::End(Outcome::Rejected(format!(
                    "not started: the watchdog has not confirmed within {}; try again",
                    human_time(CONFIRM)
                ))));
            }
            State::Running(running) => running.run.handle_timeout(now, &mut actions),
            _ => {}
        }
        self.act(actions, effects);
        if let State::Running(running) = &mut self.state
            && running.ended
            && running.run.is_over(now, || running.process.is_alive())
        {
            self.finish(effects);
        }
    }

    fn pipes(&self) -> Vec<BorrowedFd<'_>> {
        let State::Running(running) = &self.state else {
            return Vec::new();
        };
        let out = running.out.as_ref().map(AsFd::as_fd);
        let err = running.err.as_ref().map(AsFd::as_fd);
        out.into_iter().chain(err).collect()
    }

    fn read_pipes(&mut self, effects: &mut Vec<Effect>) {
        self.read(effects);
    }

    fn has_process(&self) -> bool {
        matches!(self.state, State::Running(_))
    }

    fn check_process(&mut self) {
        if let State::Running(running) = &mut self.state {
            running.ended |= running.process.has_ended();
        }
    }
}

impl ProgramJob {
    /// Announces the program to the watchdog; the rest follows.
    pub(crate) fn new(
        program: Arc<Program>,
        assignment: Assignment,
        context: JobContext,
        processes: &ProcessRegistry,
    ) -> Self {
        let charge = Charge::of(&assignment, &program.abort);
        let to_job = context.clone();
        let confirmed = move || to_job.event(JobEvent::Confirmed);
        Self {
            program,
            processes: processes.clone(),
            name: assignment.name,
            id: assignment.id,
            abort: assignment.abort,
            state: State::Announced {
                announcement: processes.announce(charge, confirmed),
                launch: assignment.launch,
                until: Instant::now().checked_add(CONFIRM),
            },
            context,
        }
    }

    fn on_confirmed(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        match std::mem::replace(&mut self.state, State::Starting(None)) {
            State::Announced {
                announcement,
                launch,
                until,
            } if until.is_none_or(|until| now < until) => {
                let started = self.start(launch, announcement, true, |task, started| {
                    task.event(JobEvent::Started(started));
                });
                if let Err(reason) = started {
                    effects.push(Effect::End(Outcome::Rejected(reason)));
                }
            }
            // A confirmation that comes too late: the timeout rejects the task.
            state => self.state = state,
        }
    }

    /// Starts a program on a thread, since that may take its time, and passes it to `then`.
    fn start(
        &self,
        launch: Launch,
        announcement: Announcement,
        piped: bool,
        then: impl FnOnce(&JobContext, Result<Process, String>) + Send + 'static,
    ) -> Result<(), String> {
        let context = self.context.clone();
        let thread = std::thread::Builder::new().name(format!("ztl-start-{}", context.id));
        let spawned = thread.spawn(move || then(&context, announcement.start(&launch, piped)));
        let failed = |error| format!("cannot start a thread: {error}");
        spawned.map(drop).map_err(failed)
    }

    fn on_started(&mut self, now: Instant, mut process: Process, effects: &mut Vec<Effect>) {
        let State::Starting(stop) = self.state else {
            return;
        };
        let (out, err) = process.take_pipes();
        let mut actions = Vec::new();
        let mut run = Run::new(now, Arc::clone(&self.program), &mut actions);
        if let Some(why) = stop {
            run.stop(now, why, &mut actions);
        }
        self.state = State::Running(Box::new(Running {
            run,
            process,
            out: out.filter(|out| ioctl_fionbio(out, true).is_ok()),
            err: err.filter(|err| ioctl_fionbio(err, true).is_ok()),
            ended: false,
        }));
        self.act(actions, effects);
    }

    fn act(&mut self, actions: Vec<Action>, effects: &mut Vec<Effect>) {
        for action in actions {
            match action {
                Action::Accept => effects.push(Effect::Accept),
                Action::Progress(text) => effects.push(Effect::Progress(text)),
                Action::Signal(signal) => self.signal(signal),
                Action::RunAbort => self.run_abort(),
            }
        }
    }

    fn signal(&self, signal: Signal) {
        if let State::Running(running) = &self.state {
            running.process.signal(signal);
        }
    }

    fn run_abort(&self) {
        let Some(launch) = self.abort.clone() else {
            return;
        };
        if let Err(reason) = launch.and_then(|launch| self.start_abort(launch)) {
            self.on_abort_not_started(&reason);
        }
    }

    fn start_abort(&self, launch: Launch) -> Result<(), String> {
        let grace = self.program.abort.grace;
        let place = launch.place.clone();
        // Starts without the watchdog's confirmation, since it stops something.
        let charge = Charge::new(&self.name, &self.id, Ending::Wait, grace);
        let announcement = self.processes.announce(charge, || {});
        self.start(
            launch,
            announcement,
            false,
            move |task, started| match started {
                Ok(process) => task.effect(Effect::Background(Box::new(AbortProgram {
                    process,
                    kill_at: Instant::now().checked_add(grace),
                    ended: false,
                    place,
                }))),
                Err(reason) => task.event(JobEvent::AbortNotStarted(reason)),
            },
        )
    }

    fn on_abort_not_started(&self, reason: &str) {
        let name = &self.name;
        warn!(target: LOG, "Cannot start the abort program of {name}, sent SIGTERM instead: {reason}");
        self.signal(Signal::TERM);
    }

    /// Reads both pipes once. Returns whether there was anything.
    fn read(&mut self, effects: &mut Vec<Effect>) -> bool {
        let State::Running(running) = &mut self.state else {
            return false;
        };
        let name = &self.name;
        let mut buffer = [0; READ];
        let mut actions = Vec::new();
        let mut any = false;
        let is_stream = self.program.result == ResultKind::Stream;
        let was_open = running.out.is_some();
        let most = if is_stream { STREAM_READ } else { READ };
        if let Some(bytes) = read(&mut running.out, buffer.get_mut(..most).unwrap_or_default()) {
            match is_stream {
                true => effects.push(Effect::Output(bytes.to_vec())),
                false => running.run.handle_output(bytes, &mut actions),
            }
            any = true;
        } else if is_stream && was_open && running.out.is_none() {
            running.run.on_closed_output(Instant::now());
        }
        if let Some(bytes) = read(&mut running.err, &mut buffer) {
            let log = |line: &str| debug!(target: LOG, "From {name}: {line}");
            running.run.handle_error_output(bytes, log);
            any = true;
        }
        self.act(actions, effects);
        any
    }

    /// The program is over: reads what it wrote last and reports the outcome.
    fn finish(&mut self, effects: &mut Vec<Effect>) {
        let State::Running(running) = &mut self.state else {
            return;
        };
        let status = running.process.reap(!running.run.leaves_behind());
        for _ in 0..LAST_READS {
            if !self.read(effects) {
                break;
            }
        }
        let State::Running(running) = std::mem::replace(&mut self.state, State::Ended) else {
            return;
        };
        let mut actions = Vec::new();
        let outcome = running.run.end(status.ok(), &mut actions);
        self.act(actions, effects);
        effects.push(Effect::End(outcome));
    }
}

/// Reads once; `None` if there is nothing now. Closes the pipe at its end.
fn read<'b>(pipe: &mut Option<impl Read>, buffer: &'b mut [u8]) -> Option<&'b [u8]> {
    match pipe.as_mut()?.read(buffer) {
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
            ) =>
        {
            None
        }
        Ok(0) | Err(_) => {
            *pipe = None;
            None
        }
        Ok(count) => buffer.get(..count),
    }
}

/// A program that stops another one. It may outlive the task.
struct AbortProgram {
    process: Process,
    kill_at: Option<Instant>,
    ended: bool,
    /// Where the file names it.
    place: String,
}

impl Job for AbortProgram {
    fn stop(&mut self, now: Instant, _: StopReason, _: &mut Vec<Effect>) {
        self.kill_at = Some(now);
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.kill_at
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.kill_at.is_some_and(|at| at <= now) {
            self.kill_at = None;
            self.process.signal(Signal::KILL);
        }
        if self.ended {
            let status = self.process.reap(true);
            if !status.as_ref().is_ok_and(ExitStatus::success) {
                let how = status.map_or_else(|error| error.to_string(), |it| it.to_string());
                let place = &self.place;
                warn!(target: LOG, "The abort program at {place} has ended with: {how}");
            }
            effects.push(Effect::End(Outcome::Completed(String::new())));
        }
    }

    fn has_process(&self) -> bool {
        true
    }

    fn check_process(&mut self) {
        self.ended |= self.process.has_ended();
    }
}
