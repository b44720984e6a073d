//! Names and addresses of machines.

use std::io;
use std::net::{IpAddr, Ipv4Addr, ToSocketAddrs as _, UdpSocket};

use crate::uri::Address;

/// The value of an environment variable that is not empty.
pub(super) fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

pub(super) fn own_host() -> Option<String> {
    variable("ROS_HOSTNAME").or_else(|| variable("ROS_IP"))
}

/// Under which name or address the other nodes of this master reach this machine. `None` if the master's host is unknown.
pub(super) fn host_towards(master: &Address) -> io::Result<Option<String>> {
    let Some(address) = resolve(&master.host) else {
        return Ok(None);
    };
    if address.is_loopback() {
        // Other machines of the robot need a name that they can resolve.
        let name = rustix::system::uname();
        let name = name.nodename().to_string_lossy().into_owned();
        let known = resolve(&name).is_some();
        return Ok(Some(match known {
            true => name,
            false => Ipv4Addr::LOCALHOST.to_string(),
        }));
    }
    // Sends nothing; the system says which address it would use.
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.connect((address, master.port))?;
    Ok(Some(socket.local_addr()?.ip().to_string()))
}

/// The address of a host, preferably IPv4, which all nodes of ROS 1 use. May block.
pub(crate) fn resolve(host: &str) -> Option<IpAddr> {
    if let Some(address) = resolve_literal(host) {
        return Some(address);
    }
    let addresses: Vec<_> = (host, 0).to_socket_addrs().ok()?.collect();
    let v4 = addresses.iter().find(|address| address.is_ipv4());
    v4.or(addresses.first()).map(|address| address.ip())
}

/// The address of a host, if that needs no lookup.
pub(super) fn resolve_literal(host: &str) -> Option<IpAddr> {
    match host {
        "localhost" => Some(Ipv4Addr::LOCALHOST.into()),
        host => host.parse().ok(),
    }
}
