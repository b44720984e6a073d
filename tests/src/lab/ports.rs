//! TCP ports that a test must name before a server binds them.

use std::hash::{BuildHasher, RandomState};
use std::net::{TcpStream, UdpSocket};

/// Ports to choose from: more than all tests together need.
const COUNT: u16 = 10_000;

/// The lowest ephemeral port of Linux by default. Other systems start higher.
const EPHEMERAL: u16 = 32_768;

/// A TCP port at which nothing listens, and which no other test gets until this program ends.
///
/// The system gives it to no connection either: it lies below the ephemeral range. Programs other than tests
/// may still bind it, so a test prefers servers that choose their port (`-p 0`) and say it, and
/// [`Process::wait_for_unless_taken`](super::Process::wait_for_unless_taken) for those that cannot.
///
/// # Panics
/// When every port of the range is taken.
#[must_use]
pub fn reserve_port() -> u16 {
    let end = ephemeral_start().min(30_000);
    let start = end - COUNT;
    // Random, so that a client that outlives its test does not connect to the next test's server.
    let first = RandomState::new().hash_one(()) % u64::from(COUNT);
    let first = first as u16;
    let mut ports = (first..COUNT).chain(0..first).map(|step| start + step);
    let port = ports.find_map(|port| {
        // The UDP port of this number is the lock: the system releases it when this program ends.
        let lock = UdpSocket::bind(("127.0.0.1", port)).ok()?;
        // Asked by connecting: a listener would stay in every program that another test is just starting.
        TcpStream::connect(("127.0.0.1", port)).err()?;
        std::mem::forget(lock);
        Some(port)
    });
    port.unwrap_or_else(|| panic!("no free port from {start} to {end}"))
}

/// Where the ports of connections start; the usual start if there is no room below it.
fn ephemeral_start() -> u16 {
    let range = std::fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range");
    let start = range.ok().and_then(|range| {
        let start = range.split_whitespace().next()?;
        start.parse().ok()
    });
    start
        .filter(|start| *start > COUNT + 1024)
        .unwrap_or(EPHEMERAL)
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_reserved_port_is_free_below_the_ephemeral_range_and_given_once() {
        let ports: std::collections::BTreeSet<u16> = (0..50).map(|_| reserve_port()).collect();
        assert_eq!(ports.len(), 50);
        for port in ports {
            assert!(port < ephemeral_start(), "{port}");
            TcpListener::bind(("127.0.0.1", port)).expect("nothing listens there");
            UdpSocket::bind(("127.0.0.1", port)).expect_err("it is reserved");
        }
    }
}
