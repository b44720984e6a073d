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

use ztl_tests::lab::{ClientOutput, PATIENCE, Process, Server};

/// Starts the original's client and ours at the original's server and at ours, and checks that all four tell the same, which
/// ends with `last`.
#[track_caller]
fn same_output(
    servers: &[Server; 2],
    clients: [&dyn Fn(&Server) -> Process; 2],
    last: &str,
) -> String {
    let runs = clients.map(|start| {
        servers
            .each_ref()
            .map(|server| (start(server), server.port))
    });
    let [[expected, other], ours] =
        runs.map(|runs| runs.map(|(run, port)| ClientOutput::of(&run.end(PATIENCE), port)));
    expected.assert_ends_with(last);
    assert_eq!(other, expected, "the original's client, our server");
    assert_eq!(ours[0], expected, "our client, the original's server");
    assert_eq!(ours[1], expected, "our client, our server");
    expected.text
}
