//! `ztl demo`: a gateway, two simulated devices on ptys, and a scene.

mod tasks;

use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

use tracing::Level;
use ztl_sim::Kind;
use ztl_std::gateway::Gateway;
use ztl_std::{RemoteTask, TaskServer};

use self::tasks::{DemoTask, play};
use crate::exit::Done;
use crate::option_values::port;
use crate::terminal::line;
use crate::{log, signals};

#[derive(Debug, clap::Args)]
pub(crate) struct Demo {
    /// End after the scene; exit code 0 only if every task completed
    #[arg(long)]
    once: bool,

    /// Port to serve at, on this machine only
    #[arg(short, long, default_value_t = 12345, value_parser = port)]
    port: u16,

    /// Also serve the web console for these devices, on this machine only, and print its link
    #[cfg(feature = "web")]
    #[arg(long)]
    web: bool,
}

const SCOPE: &str = "/lab";

const fn finger(goal: &'static str, way: (f32, f32)) -> DemoTask {
    DemoTask {
        handler: "gripper",
        component: "finger",
        goal,
        way,
        unit: "percent",
    }
}

const fn pan(goal: &'static str, way: (f32, f32)) -> DemoTask {
    DemoTask {
        handler: "head",
        component: "pan",
        goal,
        way,
        unit: "degrees",
    }
}

/// The scene: steps in order, with the acts of a step at the same time.
const SCENE: [(&str, &[DemoTask]); 4] = [
    ("open the gripper", &[finger("80", (0.0, 80.0))]),
    ("look to the left", &[pan("left", (0.0, 90.0))]),
    (
        "close it and look to the right, together",
        &[finger("20", (80.0, 20.0)), pan("right", (90.0, -90.0))],
    ),
    ("look straight ahead", &[pan("straight", (-90.0, 0.0))]),
];

/// The devices that the scene moves.
const DEVICES: [Kind; 2] = [Kind::Gripper, Kind::Head];

impl Demo {
    pub(crate) fn run(self) -> Done {
        log::init(Level::WARN);
        signals::catch()?;
        let mut server = TaskServer::bind(&format!("tcp://127.0.0.1:{}", self.port))
            .map_err(|error| format!("{error} (--port N)"))?;
        let endpoint = server.endpoint().to_owned();
        line("client ──ZeroMQ──▶ gateway ──serial link──▶ device (real node, simulated motors)");
        line("");
        let mut gateway = Gateway::new();
        let mut devices = Vec::new();
        for kind in DEVICES {
            let (url, device) = simulate(kind);
            line(format_args!("device   {kind:<8} at {url}"));
            gateway.add(kind.name(), ztl_sim::endpoint(&url)?)?;
            devices.extend(device);
        }
        server.register_handler(SCOPE, gateway);
        line(format_args!("gateway  at {endpoint}, scope {SCOPE}"));
        let server = server.spawn()?;
        #[cfg(feature = "web")]
        if self.web {
            let link = crate::web::serve_on_this_machine("demo", &endpoint, SCOPE)?;
            line(format_args!("console  at {link}"));
        }

        let mut remote = RemoteTask::connect(&endpoint, SCOPE)?;
        let start = Instant::now();
        let mut all = true;
        for (title, step) in SCENE {
            line(format_args!("\n{title}"));
            let completed = play(&mut remote, start, step);
            if let Some(code) = signals::exit_code() {
                // With --once, success would claim that the scene was played.
                return Ok(match self.once {
                    true => code,
                    false => signals::exit_code_or(outcome(all)),
                });
            }
            all &= completed;
        }
        line("");
        if self.once {
            line(if all {
                "Every task completed."
            } else {
                "Not every task completed."
            });
        } else {
            line(invitation(&endpoint));
            signals::wait();
        }
        drop(server);
        drop(devices);
        Ok(signals::exit_code_or(outcome(all)))
    }
}

const fn outcome(all_completed: bool) -> ExitCode {
    match all_completed {
        true => ExitCode::SUCCESS,
        false => ExitCode::FAILURE,
    }
}

/// Starts a device on a pty. Without ptys, the gateway starts one in its own process.
fn simulate(kind: Kind) -> (String, Option<ztl_sim::Running>) {
    #[cfg(unix)]
    if let Ok((device, path)) = ztl_sim::Device::new(kind).on_pty(None) {
        let baud = ztl_std::gateway::BAUD;
        return (format!("serial:{path}?baud={baud}"), Some(device));
    }
    (format!("sim:{kind}"), None)
}

/// Suggests what to try next.
fn invitation(endpoint: &str) -> String {
    let port = endpoint.rsplit(':').next().unwrap_or_default();
    let ours = std::env::args().next().unwrap_or_else(|| "ztl".to_owned());
    let ours = Path::new(&ours).display();
    format!(
        "The gateway goes on serving. In another terminal, with this program:\n\
         \n  {ours} task-client -r 127.0.0.1 -p {port} -s {SCOPE} gripper:finger:40\n\
         \nor with the original's:\n\
         \n  python3 -m venv venv && venv/bin/pip install ztl\
         \n  venv/bin/ztl_task_client -r 127.0.0.1 -p {port} -s {SCOPE} head:pan:left\n\
         \nCtrl-C ends it."
    )
}
