//! Where processes listen: `tcp://HOST:PORT`.

/// A place to connect to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Endpoint {
    /// A name or an address, without brackets.
    pub host: String,
    /// The TCP port.
    pub port: u16,
}

impl Endpoint {
    /// Parses `tcp://HOST:PORT`, also with an IPv6 address in brackets.
    ///
    /// # Errors
    /// What is expected.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wrong = || format!("'{text}' is not an address, as tcp://nao.local:9559");
        if text.starts_with("tcps://") {
            return Err(format!(
                "'{text}' is encrypted, which is not supported yet: expected tcp://"
            ));
        }
        let rest = text.strip_prefix("tcp://").ok_or_else(wrong)?;
        let (host, port) = rest
            .rsplit_once(':')
            .filter(|(_, port)| !port.ends_with(']'))
            .ok_or_else(|| format!("'{text}' has no port, as tcp://nao.local:9559"))?;
        let bare = host
            .strip_prefix('[')
            .and_then(|host| host.strip_suffix(']'));
        let host = bare.unwrap_or(host);
        let port = port
            .parse()
            .ok()
            .filter(|port| *port > 0)
            .ok_or_else(wrong)?;
        if host.is_empty() || host.contains(['/', '[', ']', ' ']) {
            return Err(wrong());
        }
        Ok(Self {
            host: host.to_owned(),
            port,
        })
    }

    /// Whether it is on the machine that connects.
    fn is_loopback(&self) -> bool {
        self.host == "localhost" || self.host == "::1" || self.host.starts_with("127.")
    }
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.host.contains(':') {
            true => write!(f, "tcp://[{}]:{}", self.host, self.port),
            false => write!(f, "tcp://{}:{}", self.host, self.port),
        }
    }
}

/// The endpoints of a service that can be reached from where its directory was reached, the best first.
pub(crate) fn reachable(endpoints: &[&str], directory: &Endpoint) -> Vec<Endpoint> {
    let endpoints = endpoints
        .iter()
        .filter_map(|text| Endpoint::parse(text).ok());
    // Those on the loopback of another machine lead to a wrong process of this one.
    let mut endpoints: Vec<Endpoint> = endpoints
        .filter(|endpoint| directory.is_loopback() || !endpoint.is_loopback())
        .collect();
    endpoints.sort_by_key(|endpoint| {
        let same_host = endpoint.host == directory.host;
        (
            !same_host,
            directory.is_loopback() && !endpoint.is_loopback(),
        )
    });
    endpoints.dedup();
    endpoints.truncate(8);
    endpoints
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn chosen(endpoints: &[&str], directory: &str) -> String {
        let directory = Endpoint::parse(directory).unwrap();
        let chosen = reachable(endpoints, &directory);
        let chosen: Vec<String> = chosen.iter().map(Endpoint::to_string).collect();
        chosen.join(" ")
    }

    #[test]
    fn endpoints_are_chosen_that_can_be_reached() {
        let endpoints = [
            "tcp://127.0.0.1:41000",
            "tcp://198.18.0.1:41000",
            "tcps://10.0.0.7:41001",
            "qi:ALMemory",
            "tcp://10.0.0.7:41000",
        ];
        let far = "tcp://10.0.0.7:41000 tcp://198.18.0.1:41000";
        assert_eq!(chosen(&endpoints, "tcp://10.0.0.7:9559"), far);
        let near = "tcp://127.0.0.1:41000 tcp://198.18.0.1:41000 tcp://10.0.0.7:41000";
        assert_eq!(chosen(&endpoints, "tcp://127.0.0.1:9559"), near);
        assert_eq!(chosen(&endpoints, "tcp://localhost:9559"), near);
        let far = "tcp://198.18.0.1:41000 tcp://10.0.0.7:41000";
        assert_eq!(chosen(&endpoints, "tcp://nao.local:9559"), far);
        assert_eq!(
            chosen(&["tcp://[fe80::7]:1"], "tcp://[fe80::7]:9559"),
            "tcp://[fe80::7]:1"
        );
        assert_eq!(chosen(&["tcp://127.0.0.1:1"], "tcp://nao.local:9559"), "");
    }

    #[test]
    fn malformed_addresses_are_errors() {
        for text in [
            "",
            "nao.local",
            "tcp://nao.local",
            "tcp://:9559",
            "tcp://nao:0",
            "tcp://nao:65536",
            "udp://a:1",
        ] {
            let error = Endpoint::parse(text).unwrap_err();
            assert!(error.ends_with("as tcp://nao.local:9559"), "{error}");
        }
        let error = Endpoint::parse("tcps://10.0.0.7:9503").unwrap_err();
        assert!(error.contains("encrypted"), "{error}");
    }
}
