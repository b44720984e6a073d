//! `ztl task-server`: the original's test server.

use std::process::ExitCode;
use std::time::Duration;

use tracing::{Level, error};
use ztl_core::integer::Integer;
use ztl_std::{
    ExecutableTask, Limits, Offers, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer as Server,
};

use crate::connect_options::TransportOption;
use crate::exit::Done;
use crate::listen_options::LimitOptions;
use crate::option_values::{no_number, port, scope_to_serve};
use crate::terminal::line;
use crate::{log, signals};

#[derive(Debug, clap::Args)]
pub(crate) struct TaskServer {
    /// The port on the local machine that the server should listen to
    #[arg(short, long, value_parser = port)]
    port: u16,

    /// The scope that the server should respond to
    #[arg(short, long, value_parser = scope_to_serve)]
    scope: String,

    #[command(flatten)]
    limits: LimitOptions,

    #[command(flatten)]
    transport: TransportOption,
}

impl TaskServer {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        // All interfaces, as the original.
        let mut server = Server::builder()
            .limits(self.limits.over(Limits::default()))
            .transport(self.transport.get()?)
            .bind(&format!("tcp://*:{}", self.port))?;
        server.register(&self.scope, TestController);
        let stopper = server.handle();
        signals::then(move || stopper.stop());
        server.listen()?;
        error!(target: "root", "Interrupted, exiting.");
        Ok(signals::exit_code_or(ExitCode::FAILURE))
    }
}

struct TestController;

impl TaskController for TestController {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        if request.handler == "test" {
            Ok(Box::new(TestTask {
                component: request.component.clone(),
                goal: request.goal.clone(),
            }))
        } else {
            Err(format!("No such handler '{}', try 'test'.", request.handler).into())
        }
    }

    fn offers(&self) -> Offers {
        let components = ["echo", "print", "sleep"].map(str::to_owned).to_vec();
        Offers::from([("test".to_owned(), components)])
    }
}

struct TestTask {
    component: String,
    goal: String,
}

impl ExecutableTask for TestTask {
    fn execute(self: Box<Self>, _context: &TaskContext) -> Result<String, TaskError> {
        match self.component.as_str() {
            "echo" => Ok(self.goal),
            "print" => {
                line(format_args!("component: {}", self.component));
                line(format_args!("goal: {}", self.goal));
                Ok("True".to_owned())
            }
            "sleep" => {
                let number = Integer::parse(&self.goal).map_err(|_| no_number(&self.goal))?;
                let seconds = number.value().map(u64::try_from);
                match seconds {
                    Some(Ok(seconds)) => std::thread::sleep(Duration::from_secs(seconds)),
                    Some(Err(_)) => return Err("sleep length must be non-negative".into()),
                    None => return Err("timestamp too large to convert to C _PyTime_t".into()),
                }
                Ok("True".to_owned())
            }
            other => Err(format!("No such component '{other}', try 'echo/print/sleep'.").into()),
        }
    }

    /// The original's test task cannot be aborted.
    fn can_abort(&self) -> bool {
        false
    }
}
