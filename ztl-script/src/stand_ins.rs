//! Servers that stand in for those of a script, to rehearse without a robot: `--simulate`.

use std::collections::BTreeSet;
use std::io;
use std::time::Duration;

use super::model::Script;
use ztl_std::remotes::Remote;
use ztl_std::{
    ExecutableTask, Remotes, RunningServer, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer,
};

/// How many steps a task's progress has.
const STEPS: u32 = 20;

/// Stand-ins that serve as long as this lives.
#[derive(Debug)]
#[must_use = "dropped, they are gone"]
pub struct StandIns {
    _servers: Vec<RunningServer>,
}

/// Takes what the script has for it, and nothing else.
struct StandIn {
    tasks: BTreeSet<(String, String)>,
    lasts: Duration,
}

impl StandIns {
    /// A stand-in for each server that the script uses, with tasks that last so long; `remotes` then name
    /// them.
    ///
    /// # Errors
    /// When one cannot be started.
    pub fn start(script: &Script, remotes: &mut Remotes, lasts: Duration) -> io::Result<Self> {
        let mut servers = Vec::new();
        for name in script.remotes() {
            let scope = remotes.task(name).map(|remote| remote.scope.clone());
            let scope = scope.unwrap_or_else(|_| "/stand-in".to_owned());
            let mut tasks = BTreeSet::new();
            for step in script.scenes.iter().flat_map(|scene| &scene.steps) {
                for task in &step.tasks {
                    if let Some(handler) =
                        step.handler(task).filter(|handler| handler.remote == name)
                    {
                        tasks.insert((handler.name.clone(), task.component.clone()));
                    }
                }
            }
            let mut server = TaskServer::bind("tcp://127.0.0.1:*").map_err(io::Error::other)?;
            server.register(&scope, StandIn { tasks, lasts });
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
            };
            remotes.set_task(name, remote);
            servers.push(server);
        }
        Ok(Self { _servers: servers })
    }
}

impl TaskController for StandIn {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let asked = (request.handler.clone(), request.component.clone());
        if !self.tasks.contains(&asked) {
            let known: Vec<String> = self
                .tasks
                .iter()
                .map(|(of, part)| format!("{of}:{part}"))
                .collect();
            let (of, part) = asked;
            return Err(format!(
                "no '{of}:{part}' in the script; it has: {}",
                known.join(", ")
            )
            .into());
        }
        let lasts = self.lasts;
        Ok(Box::new(move |task: &TaskContext| {
            for step in 0..STEPS {
                task.progress(format!("{} percent", step * 100 / STEPS));
                task.sleep(lasts / STEPS)?;
            }
            Ok("simulated".to_owned())
        }))
    }
}
