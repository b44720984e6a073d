//! Checks name resolution, addresses, ports, and a remote server.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::json;
use ztl_std::{RemoteTask, RequestError};

use super::finding::Finding;
use crate::connect_options::ConnectOptions;
use crate::server_address::ServerAddress;

/// How long a connection may take.
const PATIENCE: Duration = Duration::from_secs(3);

/// How many requests measure the round trip.
const ROUNDS: usize = 9;

/// Checks name resolution. A static binary has its own resolver.
pub(super) fn names() -> Vec<Finding> {
    let read = |path: &str| fs::read_to_string(path).unwrap_or_default();
    let config = read("/etc/resolv.conf");
    let servers: Vec<&str> = config
        .lines()
        .filter_map(|line| line.strip_prefix("nameserver"))
        .map(str::trim)
        .collect();
    let hosts = read("/etc/hosts");
    let entries = hosts.lines().filter(|line| {
        let line = line.trim();
        !line.is_empty() && !line.starts_with('#')
    });
    let entries = entries.count();
    let text = format!(
        "{}, {entries} lines in /etc/hosts",
        match servers.as_slice() {
            [] => "no name server in /etc/resolv.conf".to_owned(),
            some => format!("name servers {}", some.join(", ")),
        }
    );
    let data = json!({ "name_servers": servers, "hosts": entries });
    let mut found = vec![
        match (servers.is_empty(), entries) {
            (true, 0) => Finding::note("names", text).with_remedy(
                "write hosts by their addresses, or into /etc/hosts: `192.168.1.7 robot`",
            ),
            _ => Finding::good("names", text),
        }
        .with(data),
    ];
    let switch = read("/etc/nsswitch.conf");
    let mut sources = switch
        .lines()
        .filter_map(|line| line.strip_prefix("hosts:"));
    // A static binary does not use nsswitch.conf.
    if cfg!(target_env = "musl")
        && sources
            .next()
            .is_some_and(|sources| sources.contains("mdns"))
    {
        found.push(
            Finding::note(
                "names",
                "this system also knows names by mDNS (robot.local); this static program does not",
            )
            .with_remedy(
                "use the address, or a line in /etc/hosts: `avahi-resolve -n robot.local` tells it",
            ),
        );
    }
    found
}

/// This machine's IPv4 address, as others see it. Sends nothing.
pub(super) fn addresses() -> Finding {
    let toward = |to: &str| {
        let socket = UdpSocket::bind("0.0.0.0:0").ok()?;
        socket.connect(to).ok()?;
        let own = socket.local_addr().ok()?.ip();
        (!own.is_unspecified()).then_some(own)
    };
    // An address reserved for documentation.
    let own: Vec<IpAddr> = toward("192.0.2.1:9").into_iter().collect();
    let shown: Vec<String> = own.iter().map(IpAddr::to_string).collect();
    let data = json!({ "addresses": shown });
    match shown.as_slice() {
        [] => Finding::note(
            "network",
            "no route to others: only this machine can be reached",
        )
        .with_remedy("for a robot without a network: `ip addr`, and a cable"),
        some => Finding::good(
            "network",
            format!("others see this machine as {}", some.join(", ")),
        ),
    }
    .with(data)
}

/// Lists used ports, and checks whether the wanted ones are free.
pub(super) fn ports(wished: &[u16]) -> Vec<Finding> {
    let taken = listening(Path::new("/proc/net"));
    let shown = taken
        .as_ref()
        .map(|ports| ports.iter().map(u16::to_string).collect::<Vec<_>>());
    let all = match shown.as_deref() {
        Some([]) => Finding::good("ports", "nothing listens here"),
        Some(some) => Finding::good("ports", format!("taken here: {}", some.join(", "))),
        None => Finding::note("ports", "/proc/net/tcp cannot be read")
            .with_remedy("mount -t proc proc /proc; or ask for one: `ztl doctor --listen 12345`"),
    };
    let mut found = vec![all.with(json!({ "taken": taken }))];
    found.extend(wished.iter().map(|&port| {
        let data = json!({ "port": port });
        match TcpListener::bind(("0.0.0.0", port)) {
            Ok(_) => Finding::good("ports", format!("{port} is free")),
            Err(error) => {
                let (text, remedy) = match error.kind() {
                    ErrorKind::AddrInUse => (
                        format!("{port} is in use"),
                        format!(
                            "choose another, or stop what uses it: `ss -ltnp 'sport = :{port}'`"
                        ),
                    ),
                    ErrorKind::PermissionDenied => (
                        format!("{port} is for the superuser"),
                        "choose one from 1024 on".to_owned(),
                    ),
                    _ => (format!("{port}: {error}"), "choose another".to_owned()),
                };
                Finding::problem("ports", text, remedy)
            }
        }
        .with(data)
    }));
    found
}

/// TCP ports in state LISTEN; `None` if the kernel does not list them.
fn listening(directory: &Path) -> Option<BTreeSet<u16>> {
    let mut ports = BTreeSet::new();
    // The kernel may lack IPv6.
    let texts = [
        fs::read_to_string(directory.join("tcp")).ok()?,
        fs::read_to_string(directory.join("tcp6")).unwrap_or_default(),
    ];
    for text in texts {
        for line in text.lines().skip(1) {
            let mut fields = line.split_whitespace();
            let (local, state) = (fields.nth(1), fields.nth(1));
            // State 0A is LISTEN.
            if state == Some("0A")
                && let Some(port) = local.and_then(|local| local.rsplit(':').next())
                && let Ok(port) = u16::from_str_radix(port, 16)
            {
                ports.insert(port);
            }
        }
    }
    Some(ports)
}

/// Checks whether a server answers, how fast, and its version.
pub(super) fn server(address: &ServerAddress, connecting: &ConnectOptions) -> Finding {
    let ServerAddress {
        host, port, keys, ..
    } = address;
    let (host, port) = (host.as_str(), u16::try_from(*port).unwrap_or_default());
    let place = format!("{host}:{port}");
    let begin = Instant::now();
    let mut addresses = match (host, port).to_socket_addrs() {
        Ok(addresses) => addresses.collect::<Vec<_>>(),
        Err(_) if host == "localhost" => vec![([127, 0, 0, 1], port).into()],
        Err(error) => {
            return Finding::problem(
                "server",
                format!("cannot resolve '{host}': {error}"),
                format!("write its address, or a line in /etc/hosts: `192.168.1.7 {host}`"),
            );
        }
    };
    let resolved = begin.elapsed();
    // As a client does.
    addresses.sort_by_key(SocketAddr::is_ipv6);
    let mut refused = None;
    let connected = addresses.iter().find_map(|address| {
        let begin = Instant::now();
        match TcpStream::connect_timeout(address, PATIENCE) {
            Ok(_) => Some((*address, begin.elapsed())),
            Err(error) => {
                refused = Some(error);
                None
            }
        }
    });
    let Some((address, tcp)) = connected else {
        let (why, remedy) = match refused.map(|error| (error.kind(), error)) {
            Some((ErrorKind::ConnectionRefused, _)) => (
                "nothing listens there".to_owned(),
                "start the server; if it runs, start it with `--bind '*'`, since by default only its own machine reaches it".to_owned(),
            ),
            Some((ErrorKind::TimedOut, _)) => (
                format!("no answer within {} s", PATIENCE.as_secs()),
                format!("is the machine on, and does a firewall between drop port {port}? `ping {host}`"),
            ),
            Some((_, error)) => (error.to_string(), format!("`ping {host}`, `ip route`")),
            None => ("it has no address".to_owned(), "write its address".to_owned()),
        };
        return Finding::problem("server", format!("{place}: {why}"), remedy);
    };
    let remote = RemoteTask::connect(&format!("tcp://{place}"), "$ztl")
        .map_err(Into::into)
        .and_then(|remote| connecting.apply(remote, keys.as_ref()));
    match remote.and_then(ask) {
        Err(error) => {
            let known = error.downcast_ref::<RequestError>();
            let (problem, remedy) = known.and_then(RequestError::advice).unwrap_or_else(|| {
                let problem = format!("accepts connections but does not answer: {error}");
                (problem, "is it a ZTL server, and does it hang?")
            });
            Finding::problem("server", format!("{place} {problem}"), remedy)
                .with(json!({ "address": address.to_string(), "connect_us": micros(tcp) }))
        }
        Ok((version, mut rounds)) => {
            rounds.sort_unstable();
            let (median, worst) = (rounds.get(rounds.len() / 2), rounds.last());
            let (median, worst) = (
                median.copied().unwrap_or_default(),
                worst.copied().unwrap_or_default(),
            );
            let who = match &version {
                Some(version) => format!("ztl {version}"),
                None => "an original server, or a compatible one".to_owned(),
            };
            let data = json!({
                "address": address.to_string(),
                "resolve_us": micros(resolved),
                "connect_us": micros(tcp),
                "version": version,
                "round_trip_us": micros(median),
                "round_trip_worst_us": micros(worst),
            });
            let text = format!(
                "{place} is {who}; round trip {:.1} ms, at worst {:.1} ms of {}",
                median.as_secs_f64() * 1e3,
                worst.as_secs_f64() * 1e3,
                rounds.len()
            );
            match version {
                Some(version) if version != env!("CARGO_PKG_VERSION") => {
                    Finding::note("server", text).with_remedy(format!(
                        "this is ztl {}; the same version at both ends is what was tried most",
                        env!("CARGO_PKG_VERSION")
                    ))
                }
                _ => Finding::good("server", text),
            }
            .with(data)
        }
    }
}

/// The server's version, if it sends one, and some round-trip times.
fn ask(
    mut remote: RemoteTask,
) -> Result<(Option<String>, Vec<Duration>), Box<dyn std::error::Error>> {
    // The first request includes connecting.
    let told = remote.ask_server("probe")?;
    let mut rounds = Vec::new();
    for _ in 0..ROUNDS {
        let begin = Instant::now();
        remote.ask_server("probe")?;
        rounds.push(begin.elapsed());
    }
    let version = told.as_deref().and_then(|told| {
        let (_, rest) = told.split_once("version: '")?;
        Some(rest.split('\'').next()?.to_owned())
    });
    Ok((version, rounds))
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_ports_are_not_reported_as_free() {
        let none = Path::new("/no/such/directory");
        assert_eq!(listening(none), None);
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
        let port = listener.local_addr().expect("its address").port();
        if let Some(ports) = listening(Path::new("/proc/net")) {
            assert!(ports.contains(&port), "{ports:?}");
        }
    }
}
