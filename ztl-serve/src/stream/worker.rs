//! The thread that runs the programs of all streams. Nothing on it blocks.

use std::collections::hash_map::RandomState;
use std::hash::BuildHasher;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use signal_hook::consts::SIGCHLD;
use signal_hook::low_level::{pipe, unregister};
use ztl_core::TaskId;
use ztl_std::Publisher;

use super::source::Source;
use super::{Origin, StreamConfig};
use crate::jobs;
use crate::kind::{Effect, Job, JobContext, Message, StopReason};
use crate::mailbox::{Inbox, Mailbox};
use crate::program::ProgramJob;
use crate::program::assignment::Assignment;
use crate::program::processes::ProcessRegistry;

/// How long no program is read while the publisher has too much to send. Programs wait, and values of others have room.
const BEHIND: Duration = Duration::from_millis(1);

/// Running streams. Dropped, it stops their programs and waits for their ends.
#[derive(Debug)]
pub struct Streams {
    mailbox: Mailbox<Message>,
    thread: Option<JoinHandle<()>>,
}

impl Streams {
    pub(crate) fn start(
        configs: &[Arc<StreamConfig>],
        processes: &ProcessRegistry,
        publisher: &Publisher,
    ) -> io::Result<Self> {
        let (mailbox, inbox) = Mailbox::new()?;
        let on_child = pipe::register(SIGCHLD, mailbox.waker()?)?;
        let now = Instant::now();
        let sources = configs.iter().map(|config| {
            let publisher = publisher.under(&config.scope);
            let is_heard = Arc::new(AtomicBool::new(false));
            let (to_source, mailbox) = (Arc::clone(&is_heard), mailbox.clone());
            publisher.watch(&config.path, move |is_heard| {
                to_source.store(is_heard, Ordering::Release);
                mailbox.wake();
            });
            Source::new(now, config, publisher, is_heard)
        });
        let worker = Worker {
            inbox,
            mailbox: mailbox.clone(),
            on_child,
            sources: sources.collect(),
            background: Vec::new(),
            processes: processes.clone(),
            publisher: publisher.under(""),
            mark: RandomState::new().hash_one(0),
            last: 0,
            is_stopping: false,
        };
        let thread = std::thread::Builder::new()
            .name("ztl-streams".to_owned())
            .spawn(move || worker.run())?;
        Ok(Self {
            mailbox,
            thread: Some(thread),
        })
    }

    /// A function that makes the programs stop, and does not wait for their ends.
    pub fn stopper(&self) -> impl Fn() + Send + 'static {
        let mailbox = self.mailbox.clone();
        move || mailbox.send(Message::Stop)
    }
}

impl Drop for Streams {
    fn drop(&mut self) {
        self.mailbox.send(Message::Stop);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

struct Worker {
    inbox: Inbox<Message>,
    mailbox: Mailbox<Message>,
    on_child: signal_hook::SigId,
    sources: Vec<Source>,
    background: Vec<Box<dyn Job>>,
    processes: ProcessRegistry,
    publisher: Publisher,
    /// Makes each `ZTL_ID` different from those of other servers.
    mark: u64,
    /// The number of the last start of a program.
    last: u32,
    is_stopping: bool,
}

impl Worker {
    /// Runs until it receives the request to stop and all programs have ended.
    fn run(mut self) {
        loop {
            self.start_programs();
            let ended = self.sources.iter().all(|source| source.job().is_none());
            if self.is_stopping && ended && self.background.is_empty() {
                return;
            }
            let ready = self.wait();
            for id in ready.readable {
                self.with_job(id, |job, effects| job.read_pipes(effects));
            }
            if ready.woken {
                self.inbox.clear();
            }
            while let Some(message) = self.inbox.next() {
                self.handle(message);
            }
            let now = Instant::now();
            let check = ready.woken || ready.timed_out;
            for source in &mut self.sources {
                let effects = source.handle_timeout(now, check);
                self.background.extend(background(effects));
            }
            jobs::tend(&mut self.background, now, check);
        }
    }

    /// Starts the programs that are due.
    fn start_programs(&mut self) {
        let now = Instant::now();
        let due = |source: &&mut Source| source.is_due(now);
        for source in self.sources.iter_mut().filter(due) {
            if self.is_stopping {
                return;
            }
            self.last = self.last.wrapping_add(1);
            let Some(id) = TaskId::new(self.last) else {
                continue;
            };
            let config = Arc::clone(&source.config);
            let context = JobContext {
                id,
                mailbox: self.mailbox.clone(),
            };
            let job: Box<dyn Job> = match &config.origin {
                Origin::Program(program) => {
                    let mark = format!("stream-{:016x}-{id}", self.mark);
                    let (scope, topic) = (&config.scope, config.topic());
                    let assignment = Assignment::of_stream(program, scope, &topic, mark);
                    let program = Arc::clone(program);
                    Box::new(ProgramJob::new(
                        program,
                        assignment,
                        context,
                        &self.processes,
                    ))
                }
                Origin::Topic(topic) => topic.job(context),
                Origin::Signal(signal) => signal.job(context),
                Origin::Event(event) => event.job(context, config.longest, &config.scope),
            };
            source.started(now, id, job);
        }
    }

    /// Waits until something happens.
    fn wait(&self) -> jobs::Ready {
        let reads = self.publisher.has_room();
        let sources = self.sources.iter().filter(|_| !self.is_stopping);
        let due = sources.filter_map(Source::poll_timeout);
        let due = due.chain((!reads).then(|| Instant::now() + BEHIND)).min();
        let jobs = self.sources.iter().filter_map(Source::job);
        jobs::wait(&self.inbox, jobs, &self.background, due, reads)
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Event(id, event) => self.with_job(id, |job, effects| {
                job.handle_event(Instant::now(), event, effects);
            }),
            Message::Effect(id, effect) => {
                let known = self.sources.iter().filter_map(Source::job);
                let is_known = known.into_iter().any(|(known, _)| known == id);
                for mut job in background(vec![effect]) {
                    if !is_known {
                        // The program that it stops has ended meanwhile.
                        job.stop(Instant::now(), StopReason::Server, &mut Vec::new());
                    }
                    self.background.push(job);
                }
            }
            Message::Stop => {
                self.is_stopping = true;
                for source in &mut self.sources {
                    let effects = source.stop(Instant::now());
                    self.background.extend(background(effects));
                }
            }
            Message::Start { .. } | Message::Abort(_) => {}
        }
    }

    /// Calls the job of this number, if it runs.
    fn with_job(&mut self, id: TaskId, call: impl FnOnce(&mut dyn Job, &mut Vec<Effect>)) {
        let mut sources = self.sources.iter_mut();
        let is_meant = |source: &&mut Source| source.job().is_some_and(|(known, _)| known == id);
        if let Some(source) = sources.find(is_meant) {
            let effects = source.with_job(Instant::now(), call);
            self.background.extend(background(effects));
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        unregister(self.on_child);
    }
}

/// The jobs that run besides those of streams: programs that stop others.
fn background(effects: Vec<Effect>) -> impl Iterator<Item = Box<dyn Job>> {
    effects.into_iter().filter_map(|effect| match effect {
        Effect::Background(job) => Some(job),
        _ => None,
    })
}
