//! Simulated servers in place of those of a script, to rehearse without a robot: `--simulate`.

use std::collections::BTreeSet;
use std::io;
use std::time::Duration;

use ztl_script::Script;
use ztl_std::remotes::Remote;
use ztl_std::{
    ExecutableTask, Remotes, RunningServer, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer,
};

/// Progress reports per task.
const STEPS: u32 = 20;

/// Simulated servers, which run until this is dropped.
#[must_use = "dropping it stops the servers"]
pub(super) struct SimulatedServers {
    _servers: Vec<RunningServer>,
}

/// Accepts the script's tasks and nothing else.
struct SimulatedController {
    tasks: BTreeSet<(String, String)>,
    duration: Duration,
}

impl SimulatedServers {
    /// Starts a server for each server of the script, with tasks of this duration, and enters them into
    /// `remotes`.
    ///
    /// # Errors
    /// When one cannot be started.
    pub(super) fn start(
        script: &Script,
        remotes: &mut Remotes,
        duration: Duration,
    ) -> io::Result<Self> {
        let mut servers = Vec::new();
        for name in script.remotes() {
            let scope = remotes.task(name).map(|remote| remote.scope.clone());
            let scope = scope.unwrap_or_else(|_| "/stand-in".to_owned());
            let tasks = script
                .tasks_of(name)
                .map(|(handler, task)| (handler.name.clone(), task.component.clone()))
                .collect();
            let mut server = TaskServer::bind("tcp://127.0.0.1:*").map_err(io::Error::other)?;
            server.register(&scope, SimulatedController { tasks, duration });
            let server = server.spawn()?;
            let port = server
                .endpoint()
                .rsplit(':')
                .next()
                .and_then(|port| port.parse().ok());
            let remote = Remote {
                host: "127.0.0.1".to_owned(),
                port: port.unwrap_or_default(),
                scope,
                keys: None,
            };
            remotes.set_task(name, remote);
            servers.push(server);
        }
        Ok(Self { _servers: servers })
    }
}

impl TaskController for SimulatedController {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let asked = (request.handler.clone(), request.component.clone());
        if !self.tasks.contains(&asked) {
            let known = self.tasks.iter().map(|(of, part)| format!("{of}:{part}"));
            let known = known.collect::<Vec<_>>().join(", ");
            let (of, part) = asked;
            return Err(format!("no '{of}:{part}' in the script; it has: {known}").into());
        }
        let duration = self.duration;
        Ok(Box::new(move |task: &TaskContext| {
            for step in 0..STEPS {
                task.progress(format!("{} percent", step * 100 / STEPS));
                task.sleep(duration / STEPS)?;
            }
            Ok("simulated".to_owned())
        }))
    }
}
