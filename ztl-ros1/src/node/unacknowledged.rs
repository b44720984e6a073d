//! How many bytes of a connection the other end has not acknowledged. The call that asks the system for one connection needs
//! `unsafe`, so this reads the table of all.

use std::net::{SocketAddr, SocketAddrV4};

use mio::net::TcpStream;

/// Where Linux has the table of its IPv4 connections.
const TABLE: &str = "/proc/self/net/tcp";

/// The addresses of this end of a connection and of the other one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ends {
    ours: SocketAddrV4,
    theirs: SocketAddrV4,
}

impl Ends {
    /// Of a connection to this address, made or being made. `None` if the table does not have such a connection.
    pub(crate) fn of(stream: &TcpStream, theirs: SocketAddr) -> Option<Self> {
        match (stream.local_addr().ok()?, theirs) {
            (SocketAddr::V4(ours), SocketAddr::V4(theirs)) => Some(Self { ours, theirs }),
            _ => None,
        }
    }
}

/// What the other end has not acknowledged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    Bytes(u64),
    /// The system has closed the connection.
    Gone,
    /// The system does not tell.
    Untold,
}

/// The table, read when it is first needed.
#[derive(Debug, Default)]
pub(crate) struct Table(Option<String>);

impl Table {
    /// The bytes of a connection that were sent and not acknowledged.
    pub(crate) fn bytes(&mut self, ends: Ends) -> Missing {
        let read = || std::fs::read_to_string(TABLE).unwrap_or_default();
        find(self.0.get_or_insert_with(read), ends)
    }
}

fn find(table: &str, ends: Ends) -> Missing {
    let mut lines = table.lines();
    if !lines.next().is_some_and(|head| head.contains("tx_queue")) {
        return Missing::Untold;
    }
    let wanted = [shown(ends.ours), shown(ends.theirs)];
    let row = lines.find_map(|line| {
        let mut words = line.split_ascii_whitespace().skip(1);
        let is_it = [words.next()?, words.next()?] == wanted;
        is_it.then_some(words)
    });
    let Some(mut row) = row else {
        return Missing::Gone;
    };
    let sent = row.nth(1).and_then(|queues| queues.split_once(':'));
    let sent = sent.and_then(|(sent, _)| u64::from_str_radix(sent, 16).ok());
    sent.map_or(Missing::Untold, Missing::Bytes)
}

/// An address as the table has it.
fn shown(address: SocketAddrV4) -> String {
    let ip = u32::from_ne_bytes(address.ip().octets());
    format!("{ip:08X}:{:04X}", address.port())
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::TcpListener;

    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn bytes_count_until_the_other_end_has_room_for_them() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let theirs = std::net::TcpStream::connect(listener.local_addr().unwrap());
        let mut theirs = theirs.unwrap();
        let (ours, to) = listener.accept().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut ours = TcpStream::from_std(ours);
        let ends = Ends::of(&ours, to).unwrap();
        let missing = || Table::default().bytes(ends);
        assert_eq!(missing(), Missing::Bytes(0));
        let mut sent = 0;
        while let Ok(count) = ours.write(&[0; 100_000]) {
            sent += count;
        }
        assert!(matches!(missing(), Missing::Bytes(1..)));
        let mut received = 0;
        while received < sent {
            received += theirs.read(&mut [0; 100_000]).unwrap();
        }
        while missing() != Missing::Bytes(0) {
            std::thread::yield_now();
        }
        let other = Ends {
            theirs: ends.ours,
            ..ends
        };
        assert_eq!(Table::default().bytes(other), Missing::Gone);
    }

    #[test]
    fn a_table_of_another_form_tells_nothing() {
        let address: SocketAddrV4 = "127.0.0.1:80".parse().unwrap();
        let ends = Ends {
            ours: address,
            theirs: address,
        };
        let name = shown(address);
        let head = "sl local_address rem_address st tx_queue rx_queue";
        let row = |queues: &str| format!("{head}\n0: {name} {name} 01 {queues} rest");
        for table in ["", "a", "0: a b c d", &row("x:0"), &row("7")] {
            assert_eq!(find(table, ends), Missing::Untold, "{table}");
        }
        assert_eq!(find(head, ends), Missing::Gone);
        let table = row("0000001F:00000000");
        assert_eq!(find(&table, ends), Missing::Bytes(31));
    }
}
