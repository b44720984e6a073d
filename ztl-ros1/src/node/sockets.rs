//! Options of sockets. A connection works without them, so errors are ignored.

use std::time::Duration;

use mio::net::TcpStream;
use rustix::net::sockopt;

/// When the connection is closed, the system discards what waits, and tells the other end.
pub(super) fn discard_at_close(stream: &TcpStream) {
    let _ = sockopt::set_socket_linger(stream, Some(Duration::ZERO));
}

/// Small messages are not held back, and the system notices a peer that vanished. It works without, so errors are
/// ignored.
pub(super) fn prepare(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    let _ = sockopt::set_socket_keepalive(stream, true);
    #[cfg(target_os = "linux")]
    {
        let _ = sockopt::set_tcp_keepidle(stream, Duration::from_secs(20));
        let _ = sockopt::set_tcp_keepintvl(stream, Duration::from_secs(5));
    }
}

/// The system sends what waits when the connection is closed.
pub(super) fn deliver_at_close(stream: &TcpStream) {
    let _ = sockopt::set_socket_linger(stream, None);
}

/// The system closes a connection whose other end acknowledges nothing for this time, also while this process cannot look. It
/// discards what waits, also if this process is killed.
pub(super) fn limit(stream: &TcpStream, limit: Duration) {
    discard_at_close(stream);
    #[cfg(target_os = "linux")]
    {
        let millis = u32::try_from(limit.as_millis()).unwrap_or(u32::MAX);
        let _ = sockopt::set_tcp_user_timeout(stream, millis);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = limit;
}
