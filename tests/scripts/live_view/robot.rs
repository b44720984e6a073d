//! A server whose tasks run until they are aborted, and a run that plays on it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest, TaskServer};
use ztl_tests::lab::{Process, SCOPE, Terminal, ztl};

use super::stage::{Stage, start_scene};

/// `sleep` runs until it is aborted, `stubborn` until it is also released, `held` until it is released. `babble` fails
/// with a text of so many bytes. Other tasks complete at once.
struct Sleeper {
    released: Arc<AtomicBool>,
}

impl TaskController for Sleeper {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let waits = matches!(request.component.as_str(), "stubborn" | "held");
        let sleeps = matches!(request.component.as_str(), "stubborn" | "sleep");
        let babbles = request.component == "babble";
        let length = request.goal.parse().unwrap_or(0);
        let released = Arc::clone(&self.released);
        Ok(Box::new(move |task: &TaskContext| {
            while waits && !released.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(10));
            }
            if sleeps {
                task.sleep(Duration::from_secs(600))?;
            }
            match babbles {
                true => Err(TaskError::from("no ".repeat(length / 3))),
                false => Ok(String::new()),
            }
        }))
    }
}

/// A server of sleepers.
pub struct Robot {
    pub port: u16,
    pub released: Arc<AtomicBool>,
    _server: ztl_std::RunningServer,
}

impl Robot {
    pub fn start() -> Self {
        let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
        let released = Arc::new(AtomicBool::new(false));
        let sleeper = Sleeper {
            released: Arc::clone(&released),
        };
        server.register(SCOPE, sleeper);
        let server = server.spawn().unwrap();
        let port = server.endpoint().rsplit(':').next().unwrap();
        Self {
            port: port.parse().unwrap(),
            released,
            _server: server,
        }
    }

    /// Its running tasks, as `ztl ps` lists them.
    pub fn running(&self) -> String {
        let port = self.port.to_string();
        Process::run(ztl().args(["ps", "-p", &port])).stdout
    }
}

const SHOW: &str = "\
first:
  light (wait=no): {test: {sleep: 100}}
second:
  turn: {test: {sleep: 200}}
  bow: {test: {echo: bow}}
third:
  wave: {test: {echo: wave}}
";

/// Starts a run whose second scene plays while a task of the first runs in the background.
#[track_caller]
pub fn playing_second_scene() -> (Robot, Stage, Terminal) {
    let robot = Robot::start();
    let stage = Stage::with(SHOW, &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: first");
    terminal.type_in("\r");
    terminal.shows(" Next: second");
    start_scene(&mut terminal, &stage);
    terminal.shows("▶ test:sleep:200  accepted");
    (robot, stage, terminal)
}
