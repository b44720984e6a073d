//! Addresses such as `http://robot:11311/` and `rosrpc://robot:4242`.

use std::fmt;

/// A host and its port.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Address {
    pub(crate) host: String,
    pub(crate) port: u16,
}

impl Address {
    /// Reads `SCHEME://HOST:PORT`, with or without a path.
    pub(crate) fn parse(uri: &str, scheme: &str) -> Option<Self> {
        let rest = uri.trim().strip_prefix(scheme)?.strip_prefix("://")?;
        let authority = rest.split('/').next()?;
        let (host, port) = authority.rsplit_once(':')?;
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let port = port.parse().ok().filter(|port| *port != 0)?;
        let odd = |c: char| c.is_whitespace() || c.is_control() || "/@?#".contains(c);
        if host.is_empty() || host.contains(odd) {
            return None;
        }
        Some(Self {
            host: host.to_owned(),
            port,
        })
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.host.contains(':') {
            true => write!(f, "[{}]:{}", self.host, self.port),
            false => write!(f, "{}:{}", self.host, self.port),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_strictly() {
        let read = |uri| Address::parse(uri, "http").map(|address| address.to_string());
        assert_eq!(read("http://lamp:11311/"), Some("lamp:11311".to_owned()));
        assert_eq!(read("http://10.0.0.4:1"), Some("10.0.0.4:1".to_owned()));
        assert_eq!(read("http://[::1]:80/x"), Some("[::1]:80".to_owned()));
        for uri in [
            "",
            "lamp:1",
            "rosrpc://lamp:1",
            "http://lamp",
            "http://:1",
            "http://lamp:0",
            "http://lamp:65536",
            "http://a b:1",
        ] {
            assert_eq!(read(uri), None, "{uri}");
        }
    }
}
