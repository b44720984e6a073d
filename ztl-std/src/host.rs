//! Which texts can be hosts.

/// Why a text is neither a host's name nor its address, judging by its characters, as libzmq does.
#[must_use]
pub fn mistake(host: &str) -> Option<String> {
    let odd = |c: char| c.is_ascii() && !c.is_ascii_alphanumeric() && !".-_:[]%;*".contains(c);
    let can_be_one = |text: &str| !text.is_empty() && !text.contains(odd);
    if can_be_one(host) {
        return None;
    }
    let place = host
        .strip_prefix("tcp://")
        .and_then(|place| place.rsplit_once(':'));
    let help = match place {
        Some((name, port)) if port.parse::<u16>().is_ok() && can_be_one(name) => {
            format!("write {name} as the host, and {port} as the port")
        }
        _ => "a host is a name or an address, as 192.168.1.7".to_owned(),
    };
    Some(format!("'{host}' is not a host; {help}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_is_not_a_host() {
        for (host, message) in [
            (
                "tcp://lamp:7",
                "'tcp://lamp:7' is not a host; write lamp as the host, and 7 as the port",
            ),
            (
                "ipc:///x",
                "'ipc:///x' is not a host; a host is a name or an address, as 192.168.1.7",
            ),
            (
                "",
                "'' is not a host; a host is a name or an address, as 192.168.1.7",
            ),
            (
                "tcp://ipc:///x:7",
                "'tcp://ipc:///x:7' is not a host; a host is a name or an address, as 192.168.1.7",
            ),
        ] {
            assert_eq!(mistake(host).as_deref(), Some(message));
        }
        for host in [
            "lamp",
            "lamp-1.local",
            "_lamp",
            "::1",
            "[fe80::1%eth0]",
            "lämpchen",
        ] {
            assert_eq!(mistake(host), None);
        }
    }
}
