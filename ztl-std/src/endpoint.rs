//! Ports of ZeroMQ addresses.

/// Refuses an address whose port is no port. ZeroMQ cuts it to 16 bits instead, and would connect to
/// another server, or listen where nobody looks.
pub(crate) fn check_port(endpoint: &str) -> Result<(), zmq::Error> {
    let Some((_, port)) = endpoint
        .strip_prefix("tcp://")
        .and_then(|rest| rest.rsplit_once(':'))
    else {
        return Ok(());
    };
    let number = port.strip_prefix(['-', '+']).unwrap_or(port);
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    // Anything else, as `*`, is for ZeroMQ to judge.
    match is_number && port.parse::<u16>().is_err() {
        true => Err(zmq::Error::EINVAL),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_beyond_16_bits_is_refused_by_clients_and_servers() {
        for endpoint in [
            "tcp://localhost:65536",
            "tcp://10.0.0.7:99999",
            "tcp://localhost:-1",
        ] {
            assert_eq!(check_port(endpoint), Err(zmq::Error::EINVAL), "{endpoint}");
            assert!(
                crate::RemoteTask::connect(endpoint, "/lab").is_err(),
                "{endpoint}"
            );
        }
        assert!(crate::TaskServer::bind("tcp://127.0.0.1:99999").is_err());
        for endpoint in [
            "tcp://127.0.0.1:*",
            "tcp://*:0",
            "tcp://robot:65535",
            "ipc:///a:99999",
        ] {
            assert_eq!(check_port(endpoint), Ok(()), "{endpoint}");
        }
    }
}
