//! A client: starts a task, shows its progress and waits for its final state.
//!
//!     cargo run --example client
//!
//! drives the example `handler` (or the server given as argument) and prints
//!
//!     started
//!     … 0 percent
//!     …
//!     COMPLETED: arrived

use std::time::Duration;

use ztl_std::RemoteTask;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let endpoint = std::env::args().nth(1);
    let endpoint = endpoint.as_deref().unwrap_or("tcp://127.0.0.1:5700");
    let mut robot = RemoteTask::connect(endpoint, "/robot")?;
    let task = robot.trigger("robot", "base", "forward")?;
    println!("started");
    let mut last = String::new();
    let end = robot.wait_with(task.id, Some(Duration::from_secs(10)), |answer| {
        if let Ok(status) = answer
            && !status.state.is_final()
            && status.text != last
        {
            println!("… {}", status.text);
            last.clone_from(&status.text);
        }
        true
    })?;
    println!("{}: {}", end.state, end.text);
    Ok(())
}
