//! Why routers are not reached.

use std::io::ErrorKind;
use std::net::{TcpStream, ToSocketAddrs as _};
use std::time::Duration;

use crate::config::Links;
use crate::tls::{self, Tls};

/// How long to look.
const LOOK: Duration = Duration::from_secs(1);

/// Why each of these routers may not be reached, and what helps.
pub(crate) fn obstacles(links: &Links) -> String {
    let routers = links.routers.iter();
    let all =
        routers.map(|address| format!("{address}: {}", obstacle(address, links.tls.as_ref())));
    all.collect::<Vec<_>>().join("; ")
}

fn obstacle(address: &str, tls: Option<&Tls>) -> String {
    let place = address.split_once('/').map_or("", |(_, place)| place);
    let connected = place.to_socket_addrs().and_then(|mut all| {
        let at = all.next().ok_or(ErrorKind::NotFound)?;
        let stream = TcpStream::connect_timeout(&at, LOOK)?;
        stream.set_read_timeout(Some(LOOK))?;
        stream.set_write_timeout(Some(LOOK))?;
        Ok(stream)
    });
    let stream = match connected {
        Ok(stream) => stream,
        Err(error) => return format!("{error}; start a router there, or correct 'routers'"),
    };
    let host = place.rsplit_once(':').map_or("", |(host, _)| host);
    let host = host.trim_matches(['[', ']']);
    if let Some(tls) = tls
        && let Some(why) = tls::obstacle(tls, host, stream)
    {
        return why;
    }
    // Zenoh tells no reason.
    "something listens there, but it does not answer as a router that accepts this machine; compare 'tls' with its certificates and their dates, the clocks, and the address's name and protocol, at both ends".to_owned()
}
