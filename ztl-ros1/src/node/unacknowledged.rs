//! How many bytes of a connection the other end has not acknowledged. The call that asks the system for one connection needs
//! `unsafe`, so this reads the table of all.

use std::net::SocketAddrV4;

/// Where Linux has the table of its IPv4 connections.
const TABLE: &str = "/proc/self/net/tcp";

/// The table, read when it is first needed.
#[derive(Debug, Default)]
pub(crate) struct Table(Option<String>);

impl Table {
    /// The bytes of a connection that were sent and not acknowledged. `None` if the system does not tell.
    pub(crate) fn bytes(&mut self, ours: SocketAddrV4, theirs: SocketAddrV4) -> Option<u64> {
        let read = || std::fs::read_to_string(TABLE).unwrap_or_default();
        find(self.0.get_or_insert_with(read), ours, theirs)
    }
}

fn find(table: &str, ours: SocketAddrV4, theirs: SocketAddrV4) -> Option<u64> {
    let wanted = [shown(ours), shown(theirs)];
    table.lines().find_map(|line| {
        let mut words = line.split_ascii_whitespace().skip(1);
        if [words.next()?, words.next()?] != wanted {
            return None;
        }
        let (sent, _) = words.nth(1)?.split_once(':')?;
        u64::from_str_radix(sent, 16).ok()
    })
}

/// An address as the table has it.
fn shown(address: SocketAddrV4) -> String {
    let ip = u32::from_ne_bytes(address.ip().octets());
    format!("{ip:08X}:{:04X}", address.port())
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::{SocketAddr, TcpListener, TcpStream};

    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn bytes_count_until_the_other_end_has_room_for_them() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut ours = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (mut theirs, _) = listener.accept().unwrap();
        let ends = [ours.local_addr().unwrap(), ours.peer_addr().unwrap()];
        let [SocketAddr::V4(from), SocketAddr::V4(to)] = ends else {
            panic!("{ends:?}");
        };
        let missing = || Table::default().bytes(from, to);
        assert_eq!(missing(), Some(0));
        ours.set_nonblocking(true).unwrap();
        let mut sent = 0;
        while let Ok(count) = ours.write(&[0; 100_000]) {
            sent += count;
        }
        assert!(missing().is_some_and(|bytes| bytes > 0));
        let mut received = 0;
        while received < sent {
            received += theirs.read(&mut [0; 100_000]).unwrap();
        }
        while missing() != Some(0) {
            std::thread::yield_now();
        }
        assert_eq!(Table::default().bytes(from, from), None);
    }

    #[test]
    fn a_table_of_another_form_tells_nothing() {
        let address: SocketAddrV4 = "127.0.0.1:80".parse().unwrap();
        let name = shown(address);
        for table in ["", "a", "0: a b c d", &format!("0: {name} {name} 01 x:0")] {
            assert_eq!(find(table, address, address), None, "{table}");
        }
        let table = format!("0: {name} {name} 01 0000001F:00000000 rest");
        assert_eq!(find(&table, address, address), Some(31));
    }
}
