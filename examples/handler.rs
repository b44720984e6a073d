//! The handler of a robot: an old robot runs it, and newer machines can drive it.
//!
//!     cargo run --example handler
//!
//! serves `tcp://127.0.0.1:5700`, scope `/robot`, until Ctrl-C. Then, in another terminal:
//!
//!     cargo run --example client
//!     ztl describe -r 127.0.0.1 -p 5700
//!     ztl task-client -r 127.0.0.1 -p 5700 -s /robot robot:base:forward

use std::time::Duration;

use ztl_std::describe::{ScopeDescriptions, parse};
use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest, TaskServer};

/// Drives for two seconds, reports its progress, and stops on an abort.
struct Drive;

impl ExecutableTask for Drive {
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
        for percent in (0..100).step_by(5) {
            context.progress(format!("{percent} percent"));
            // A real robot would send its base a velocity here.
            if context.sleep(Duration::from_millis(100)).is_err() {
                return Err(TaskError::aborted(format!("stopped at {percent} percent")));
            }
        }
        Ok("arrived".to_owned())
    }
}

struct Robot;

impl TaskController for Robot {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        match (request.component.as_str(), request.goal.as_str()) {
            ("base", "forward") => Ok(Box::new(Drive)),
            ("base", other) => Err(format!("no goal '{other}'; base takes: forward").into()),
            (other, _) => Err(format!("no component '{other}'; it has: base").into()),
        }
    }

    // Shown by `ztl describe`, and used by `ztl check` and shells.
    fn describe(&self) -> ScopeDescriptions {
        let base = parse("{goal: {one-of: [forward]}, about: drives for two seconds}");
        let base = base.map(|base| [("base".to_owned(), base)].into());
        base.map(|robot| [("robot".to_owned(), robot)].into())
            .unwrap_or_default()
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let endpoint = std::env::args().nth(1);
    let mut server = TaskServer::bind(endpoint.as_deref().unwrap_or("tcp://127.0.0.1:5700"))?;
    server.register("/robot", Robot);
    println!("serving /robot at {}", server.endpoint());
    server.listen()?;
    Ok(())
}
