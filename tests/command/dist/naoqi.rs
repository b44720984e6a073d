//! `ztl serve nao.yaml` on the robot's processor, as docs/robots.md says, with libqi itself beside it.

#[path = "../../naoqi/robot.rs"]
#[expect(dead_code, reason = "the tests of NAOqi use the rest")]
mod robot;

use std::path::Path;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, Server, outcome, until};

use super::place::Place;
use robot::{EXAMPLES_USE, Robot};

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn it_serves_nao() {
    let place = Place::new();
    let mut robot = Robot::start(&EXAMPLES_USE);
    // The file that the program itself writes, for this NAOqi.
    let file = Process::run(&mut place.ztl("serve --init nao"));
    assert_eq!(file.code, Some(0), "{file:?}");
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/serve/nao.yaml");
    let example = std::fs::read_to_string(example).expect("an example");
    assert_eq!(file.stdout, example);
    let text = example.replace("tcp://127.0.0.1:9559", &robot.endpoint);
    assert_ne!(text, example);
    place.write("nao.yaml", &text);
    let inside = place.path_inside("nao.yaml");
    let checked = Process::run(place.ztl("serve --check").arg(&inside));
    assert_eq!(checked.code, Some(0), "{checked:?}");
    assert!(
        checked.stdout.starts_with("Nothing is wrong: "),
        "{checked:?}"
    );

    let mut command = place.ztl("serve -p 0 --publish 0");
    let server = Server::start(command.arg(inside));
    let remote = RemoteTask::connect(&server.endpoint(), "/nao").expect("an address");
    // An emulated processor on a busy machine is slow.
    let mut remote = remote.with_timeout(PATIENCE);
    until("the service is found", PATIENCE, || {
        let ended = outcome(&mut remote, "tts", "say", "hello");
        (ended == (State::Completed, "None".to_owned())).then_some(())
    });
    robot.line_with("say hello");
    let walked = outcome(&mut remote, "motion", "walk", "{x: 0.5}");
    assert_eq!(walked, (State::Completed, "True".to_owned()));
    robot.line_with("move 0.5 0.0 0.0");
    let wait = remote.trigger("touch", "wait", "").expect("taken").id;
    until("the touch ends it", PATIENCE, || {
        robot.tell("raise FrontTactilTouched 1.0");
        let status = remote.status(&wait).expect("a status");
        (status.state == State::Completed).then_some(())
    });
    // Abort reaches the robot.
    let walk = remote
        .trigger("motion", "walk", "{x: 2}")
        .expect("taken")
        .id;
    robot.line_with("move 2.0");
    remote.abort(&walk).expect("an answer");
    robot.line_with("stopped");
    let ended = remote.wait(&walk, Some(PATIENCE)).expect("its end");
    assert_eq!(ended.state, State::Aborted, "{ended:?}");
}
