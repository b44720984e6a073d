//! Names for hosts, so that a robot's address and certificate are in one place: `http: {robot: 10.0.0.7}`.

use std::collections::BTreeMap;

use super::tls::Trust;

/// The hosts, by the names that addresses use for them.
pub(crate) type Hosts = BTreeMap<String, Host>;

/// A host.
#[derive(Debug, Default)]
pub(crate) struct Host {
    /// As it stands in an address, perhaps with its port.
    pub(super) address: String,
    /// Which certificates are right, where the file says it.
    pub(super) trust: Option<Trust>,
}

/// What is wrong with a host, as it stands in an address, perhaps with its port.
pub(super) fn mistake(host: &str) -> Option<String> {
    let (name, port) = match host.rsplit_once(':') {
        Some((name, port)) if !port.contains(']') => (name, Some(port)),
        _ => (host, None),
    };
    let bare = name.strip_prefix('[').and_then(|it| it.strip_suffix(']'));
    let fits = |c: char| match bare {
        Some(_) => c.is_ascii_hexdigit() || matches!(c, ':' | '.'),
        None => c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_'),
    };
    let name = bare.unwrap_or(name);
    let good_port = port.is_none_or(|port| port.parse::<u16>().is_ok_and(|port| port > 0));
    let good = good_port && !name.is_empty() && name.chars().all(fits);
    (!good).then(|| format!("'{host}' is not a host, as 10.0.0.7 or robot.local:8080"))
}
