//! Calls of NAOqi: our client and a task of `ztl serve`, beside libqi's own client. `cargo xtask bench naoqi` runs it.

#[path = "../naoqi/robot.rs"]
#[expect(dead_code, reason = "the tests of NAOqi use the rest")]
mod robot;

use std::time::Instant;

use ztl_std::State;
use ztl_tests::lab::{PATIENCE, Scratch, Server, connect_to, outcome, until, ztl};

use robot::{Connected, Robot};

/// Calls that are measured in a round.
const CALLS: usize = 2000;
const ROUNDS: usize = 3;

/// The median of some calls, in microseconds.
fn median(mut call: impl FnMut()) -> u128 {
    let times = (0..CALLS).map(|_| {
        let start = Instant::now();
        call();
        start.elapsed().as_micros()
    });
    let mut times: Vec<u128> = times.collect();
    times.sort_unstable();
    times[CALLS / 2]
}

fn main() {
    let mut robot = Robot::start(&["ALLeds"]);
    let nao = Connected::to(&robot);
    let scratch = Scratch::new();
    let file = scratch.path("nao.yaml");
    let text = format!(
        "naoqi: {}\nscopes: {{/nao: {{p: {{color: {{naoqi: ALLeds.fadeRGB, arguments: [FaceLeds, 255, 0.5]}}, echo: echo}}}}}}\n",
        robot.endpoint
    );
    std::fs::write(&file, text).expect("to write");
    let server = Server::start(ztl().arg("serve").arg(&file).args(["-p", "0"]));
    let mut remote = connect_to(&server.endpoint(), "/nao");
    let mut task = |component: &str| outcome(&mut remote, "p", component, "").0;
    until("the service is found", PATIENCE, || {
        (task("color") == State::Completed).then_some(())
    });
    println!("{CALLS} calls one after the other, the median in microseconds:");
    for _ in 0..ROUNDS {
        robot.process.write_line(&format!("time {CALLS}"));
        let line = robot.line_with("p50 ");
        let theirs = line.trim().trim_start_matches("p50 ").to_owned();
        let ours = median(|| {
            let result = nao.call("ALLeds", "fadeRGB", "[FaceLeds, 255, 0.5]");
            result.expect("a result");
        });
        let of_task = median(|| assert_eq!(task("color"), State::Completed));
        let of_echo = median(|| assert_eq!(task("echo"), State::Completed));
        println!(
            "libqi's own {theirs}    ztl-naoqi {ours}    a task of naoqi {of_task}    a task of echo {of_echo}"
        );
    }
}
