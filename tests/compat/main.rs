//! The original Python package, its tools, and other ZeroMQ implementations against ours, both ways.

mod codec;
mod goals;
mod original_client;
mod original_client_gateway;
mod original_server;
mod original_suite;
mod peers;
mod pickles;
mod simple_tools;
mod streams;
mod task_client;

use ztl_tests::lab::{ClientOutput, PATIENCE, Process, Server, until};

/// The original's client and ours.
type Clients<'a> = [&'a dyn Fn(&Server) -> Process; 2];

/// What each client tells at the original's server and at ours, where all four run at once.
#[track_caller]
fn outputs(servers: &[Server; 2], clients: Clients<'_>) -> [[ClientOutput; 2]; 2] {
    let runs = clients.map(|start| {
        servers
            .each_ref()
            .map(|server| (start(server), server.port))
    });
    runs.map(|runs| runs.map(|(run, port)| ClientOutput::of(&run.end(PATIENCE), port)))
}

/// Checks that all four tell the same, which ends with `last`.
#[track_caller]
fn same_output(servers: &[Server; 2], clients: Clients<'_>, last: &str) -> String {
    let [[expected, other], ours] = outputs(servers, clients);
    expected.assert_ends_with(last);
    assert_eq!(other, expected, "the original's client, our server");
    assert_eq!(ours[0], expected, "our client, the original's server");
    assert_eq!(ours[1], expected, "our client, our server");
    expected.text
}

/// The same where the output depends on what happens within some seconds: repeats what a busy machine delays.
#[track_caller]
fn same_output_in_time(servers: &[Server; 2], clients: Clients<'_>, last: &str) -> String {
    until("the same output", PATIENCE, || {
        let [[expected, other], ours] = outputs(servers, clients);
        println!("{expected:?}\n{other:?}\n{ours:?}");
        let is_same = [&other, &ours[0], &ours[1]]
            .iter()
            .all(|it| **it == expected);
        let ends_so = expected.text.trim_end().ends_with(last);
        (is_same && ends_so).then_some(expected.text)
    })
}
