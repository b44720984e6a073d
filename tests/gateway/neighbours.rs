//! A faulty device does not affect the others.

use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ztl_std::TriggerError;
use ztl_std::gateway::Gateway;
use ztl_tests::lab::{PATIENCE, busy, in_time, until};

use crate::lines::{complete, problem, serve};

/// The median time.
fn median(times: &mut [Duration]) -> Duration {
    times.sort();
    times[times.len() / 2]
}

/// How long a trivial task takes from INIT to its final state.
#[track_caller]
fn latency(remote: &mut ztl_std::RemoteTask) -> Duration {
    let mut times: Vec<Duration> = (0..60)
        .map(|_| {
            let start = Instant::now();
            // The current position.
            complete(remote, "head", "pan", "0");
            start.elapsed()
        })
        .collect();
    median(&mut times)
}

#[test]
fn a_flooding_silent_or_blocked_device_does_not_affect_its_neighbour() {
    let _busy = busy();
    let mut gateway = Gateway::new();
    gateway
        .add("head", ztl_sim::endpoint("sim:head").unwrap())
        .unwrap();
    let (server, mut remote) = serve(gateway);
    let alone = latency(&mut remote);
    drop(server);

    let stop = Arc::new(AtomicBool::new(false));
    let flood = TcpListener::bind("127.0.0.1:0").unwrap();
    let flooded = flood.local_addr().unwrap();
    let stopped = Arc::clone(&stop);
    let flooding = std::thread::spawn(move || {
        let mut streams: Vec<TcpStream> = Vec::new();
        flood.set_nonblocking(true).unwrap();
        while !stopped.load(Ordering::SeqCst) {
            if let Ok((stream, _)) = flood.accept() {
                stream.set_nonblocking(false).unwrap();
                stream
                    .set_write_timeout(Some(Duration::from_millis(20)))
                    .unwrap();
                streams.push(stream);
            }
            for stream in &mut streams {
                let _ = stream.write(&[0xa7; 4096]);
            }
        }
    });
    // Accepts the connection and neither reads nor writes.
    let hole = TcpListener::bind("127.0.0.1:0").unwrap();
    let swallowed = hole.local_addr().unwrap();
    let (release, hang) = mpsc::channel::<()>();
    let hang = std::sync::Mutex::new(hang);

    let mut gateway = Gateway::new();
    gateway
        .add("flood", format!("tcp:{flooded}").parse().unwrap())
        .unwrap();
    gateway
        .add("hole", format!("tcp:{swallowed}").parse().unwrap())
        .unwrap();
    gateway
        .add_line("hang", "a stuck driver", move || {
            let _ = hang.lock().unwrap().recv();
            Err(std::io::Error::other("let go"))
        })
        .unwrap();
    gateway
        .add("head", ztl_sim::endpoint("sim:head").unwrap())
        .unwrap();
    let watch = gateway.devices();
    let (server, mut remote) = serve(gateway);
    assert_eq!(
        problem(&watch, "hang"),
        "a stuck driver: opening it takes long"
    );
    assert!(problem(&watch, "hole").ends_with(": device is not answering"));
    problem(&watch, "flood");
    // The flood keeps a core busy, which the gateway cannot prevent. Waiting for any of the
    // three would take hundreds of milliseconds.
    until("its latency alone", PATIENCE, || {
        let beside = latency(&mut remote);
        println!("alone {alone:?}, beside them {beside:?}");
        (beside < alone + Duration::from_millis(50)).then_some(())
    });
    // A task for one of the faulty devices is always rejected in time.
    for device in ["flood", "hole", "hang"] {
        let refused = in_time(Duration::from_secs(2), || {
            remote.trigger(device, "any", "thing")
        });
        assert!(
            matches!(refused, Err(TriggerError::Rejected { .. })),
            "{device}: {refused:?}"
        );
    }
    // The gateway exits although the open has not returned.
    let asked = Instant::now();
    drop(server);
    assert!(
        asked.elapsed() < Duration::from_secs(5),
        "{:?}",
        asked.elapsed()
    );
    stop.store(true, Ordering::SeqCst);
    drop(release);
    flooding.join().unwrap();
}
