//! `ztl-fleet demo`: five robots in two rooms, a router, an endpoint, and a scene across all; one robot is cut off and comes
//! back. All of it runs in this process and on loopback.

mod line;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use tracing_subscriber::filter::LevelFilter;
use zenoh::{Session, Wait as _};
use ztl_fleet::config::{AgentConfig, EndpointConfig, Identity, Links};
use ztl_fleet::join::Joined;
use ztl_fleet::serve::Serving;
use ztl_fleet::session::{self, ZenohError};
use ztl_std::keys::KeyPair;
use ztl_std::listen::Listen;
use ztl_std::{
    Access, ExecutableTask, RemoteId, RemoteTask, RequestError, RunningServer, State, TaskContext,
    TaskController, TaskError, TaskRequest, TaskServer, TriggerError, Triggered,
};

use self::line::Line;
use crate::{Done, line as say, signals};

/// Robots and their rooms.
const ROBOTS: [(&str, &str); 5] = [
    ("arm-1", "room-1"),
    ("arm-2", "room-1"),
    ("arm-3", "room-1"),
    ("arm-4", "room-2"),
    ("arm-5", "room-2"),
];
/// How long its task goes on, so that it ends while nobody hears of it.
const WAVE: Duration = Duration::from_millis(1500);
/// How long anything of the demo may take.
const PATIENCE: Duration = Duration::from_secs(20);
const PAUSE: Duration = Duration::from_millis(100);

#[derive(Debug, clap::Args)]
pub(crate) struct Demo {
    /// Log what the parts of the fleet say
    #[arg(long)]
    log: bool,
}

/// Waves for a while.
struct Wave;

impl ExecutableTask for Wave {
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
        match context.sleep(WAVE) {
            Ok(()) => Ok("waved".to_owned()),
            Err(_) => Err(TaskError::aborted("stopped waving")),
        }
    }
}

struct Arm;

impl TaskController for Arm {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        Ok(Box::new(Wave))
    }
}

/// What the demo has started, in the order in which it is to end.
struct Started {
    robots: Vec<(Joined, RunningServer)>,
    router: Session,
    state: PathBuf,
}

impl Drop for Started {
    fn drop(&mut self) {
        self.robots.clear();
        // What remains ends with this process.
        let _ = self.router.close().wait();
        let _ = std::fs::remove_dir_all(&self.state);
    }
}

impl Demo {
    /// The level of the log.
    pub(crate) const fn level(&self) -> LevelFilter {
        match self.log {
            true => LevelFilter::INFO,
            false => LevelFilter::OFF,
        }
    }

    /// Exit code 0 if every task completed.
    pub(crate) fn run(&self) -> Done {
        let signals = signals::catch()?.awaited();
        let (router, address) = router()?;
        let (line, far) = Line::open(&address)?;
        say(format_args!("router    at {address}"))?;
        let state = std::env::temp_dir().join(format!("ztl-fleet-demo-{}", std::process::id()));
        let mut started = Started {
            robots: Vec::new(),
            router,
            state,
        };
        let desk = KeyPair::generate();
        let mut known = BTreeMap::new();
        for (name, room) in ROBOTS {
            let own = KeyPair::generate();
            known.insert(name.to_owned(), Some(own.public()));
            let identity = Identity {
                own,
                clients: vec![(None, desk.public())],
            };
            let is_last = ROBOTS.last().is_some_and(|last| last.0 == name);
            // The last one can be cut off.
            let router = if is_last { &far } else { &address };
            let robot = robot(name, room, router, identity, &started.state)?;
            say(format_args!(
                "{name}     in {room}, server at {}",
                robot.1.endpoint()
            ))?;
            started.robots.push(robot);
        }
        let serving = Serving::bind(&EndpointConfig {
            listen: Listen::default(),
            robots: known,
            fleet_key: Some(desk),
            access: Ok(Access::everybody()),
            links: links(&address),
        })?;
        let endpoint = serving.endpoint().to_owned();
        say(format_args!(
            "endpoint  at {endpoint}, scopes /{}/demo …",
            ROBOTS[0].0
        ))?;
        let stopper = serving.stopper();
        let thread = std::thread::Builder::new().name("ztl-fleet-endpoint".to_owned());
        thread.spawn(move || serving.run().map_err(|error| error.to_string()))?;
        let mut scene = Scene {
            endpoint,
            stop: || signals.try_recv().ok(),
        };
        let played = scene.play(&line);
        stopper.stop();
        drop(started);
        match played {
            Ok(true) => {
                say("")?;
                say("Every task completed, and none ran twice.")?;
                Ok(ExitCode::SUCCESS)
            }
            Ok(false) => {
                say("")?;
                say("Not every task completed.")?;
                Ok(ExitCode::FAILURE)
            }
            Err(Interrupted::Signal(signal)) => Ok(ExitCode::from(signals::number(signal))),
            Err(Interrupted::Failed(error)) => Err(error),
        }
    }
}

/// A router at a port that nobody else has.
fn router() -> Result<(Session, String), ZenohError> {
    let mut tries = 0;
    loop {
        tries += 1;
        // Zenoh does not tell which free port it has chosen.
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let address = format!("tcp/127.0.0.1:{port}");
        let links = Links {
            listen: vec![address.clone()],
            ..Links::default()
        };
        match session::open_router(&links) {
            Ok(router) => return Ok((router, address)),
            Err(error) if tries > 3 => return Err(error),
            Err(_) => {}
        }
    }
}

fn links(router: &str) -> Links {
    Links {
        routers: vec![router.to_owned()],
        ..Links::default()
    }
}

/// A robot's server, and its agent.
fn robot(
    name: &str,
    room: &str,
    router: &str,
    identity: Identity,
    state: &Path,
) -> Result<(Joined, RunningServer), ZenohError> {
    let mut server = TaskServer::bind("tcp://127.0.0.1:0")?;
    server.register("/demo", Arm);
    let server = server.spawn()?;
    let joined = Joined::join(AgentConfig {
        name: name.to_owned(),
        server: server.endpoint().to_owned(),
        publish: None,
        keys: None,
        scopes: Vec::new(),
        groups: vec![room.to_owned()],
        identity: Some(identity),
        state: state.join(name),
        links: links(router),
    })?;
    Ok((joined, server))
}

/// Why a scene ended before its end.
enum Interrupted {
    Signal(u8),
    Failed(ZenohError),
}

impl<E: Into<ZenohError>> From<E> for Interrupted {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

/// The scene, played through the endpoint.
struct Scene<S> {
    endpoint: String,
    /// A signal that ends it.
    stop: S,
}

impl<S: Fn() -> Option<u8>> Scene<S> {
    fn play(&mut self, line: &Line) -> Result<bool, Interrupted> {
        let mut robots = Vec::new();
        for (name, _) in ROBOTS {
            let remote = RemoteTask::connect(&self.endpoint, &format!("/{name}/demo"))?;
            robots.push((name, remote));
        }
        self.until("all robots to be there", || {
            let scopes = robots
                .first_mut()
                .and_then(|(_, robot)| robot.describe().ok()?);
            scopes.is_some_and(|told| told.scopes.len() == ROBOTS.len())
        })?;
        say("")?;
        say("all five wave, and arm-5 is cut off meanwhile")?;
        let mut tasks = Vec::new();
        for (name, mut robot) in robots {
            let task = self.start(name, &mut robot)?;
            say(format_args!("  {name}  {}", task.reply))?;
            tasks.push((name, robot, task.id));
        }
        line.cut();
        say("  arm-5 is cut off")?;
        let Some((cut, others)) = tasks.split_last_mut() else {
            return Ok(false);
        };
        let mut all = true;
        for (name, robot, task) in others {
            all &= self.end(name, robot, task)?;
        }
        let (name, robot, task) = cut;
        match robot.status(task.clone()) {
            Err(RequestError::NoAnswer { .. }) => {
                say(format_args!(
                    "  {name}  unknown: it is not reached, and nobody says that it has failed"
                ))?;
            }
            Ok(told) => {
                all = false;
                say(format_args!(
                    "  {name}  {}, though it is cut off",
                    told.state
                ))?;
            }
            Err(error) => return Err(error.into()),
        }
        say("")?;
        say("arm-5 comes back; it has gone on alone")?;
        line.join();
        all &= self.end(name, robot, task)?;
        let mut known = 0;
        self.until("the lists of all robots", || {
            // A list lacks a robot that does not answer in time.
            let list = robot.tasks().ok().flatten();
            known = list.map_or(0, |list| list.tasks.len());
            known >= ROBOTS.len()
        })?;
        Ok(all && known == ROBOTS.len())
    }

    /// Starts a robot's task. Repeats an INIT only if it did nothing, as one that came too late on a busy machine.
    fn start(&self, name: &str, robot: &mut RemoteTask) -> Result<Triggered, Interrupted> {
        let wave = |robot: &mut RemoteTask| robot.trigger("arm", "hand", "wave");
        let mut told = wave(robot);
        self.until(name, || {
            told = match &told {
                Ok(_) => return true,
                Err(TriggerError::Rejected { .. } | TriggerError::NeverCame) => wave(robot),
                Err(TriggerError::Request(error)) if error.nothing_was_sent() => wave(robot),
                Err(_) => match robot.ask_outcome() {
                    Some(outcome) => outcome,
                    None => return true,
                },
            };
            told.is_ok()
        })?;
        Ok(told?)
    }

    /// Waits for the end of a task. Returns whether it completed.
    fn end(
        &self,
        name: &str,
        robot: &mut RemoteTask,
        task: &RemoteId,
    ) -> Result<bool, Interrupted> {
        let mut told = None;
        self.until(name, || {
            told = robot.status(task.clone()).ok();
            told.as_ref().is_some_and(|told| told.state.is_final())
        })?;
        let Some(told) = told else { return Ok(false) };
        say(format_args!("  {name}  {}  {}", told.state, told.text))?;
        Ok(told.state == State::Completed)
    }

    fn until(&self, what: &str, mut holds: impl FnMut() -> bool) -> Result<(), Interrupted> {
        let end = Instant::now() + PATIENCE;
        while !holds() {
            if let Some(signal) = (self.stop)() {
                return Err(Interrupted::Signal(signal));
            }
            if Instant::now() >= end {
                return Err(Interrupted::Failed(format!("{what} took too long").into()));
            }
            std::thread::sleep(PAUSE);
        }
        Ok(())
    }
}
