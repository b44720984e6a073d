//! A component as in firmware, tested on the desk: the node talks to a gateway over TCP, without hardware.
//!
//!     cargo run --example component
//!
//! waits for a gateway on 127.0.0.1:7001:
//!
//!     ztl gateway --device desk=tcp:127.0.0.1:7001 -p 12345 -s /lab
//!     ztl task-client -r 127.0.0.1 -p 12345 -s /lab desk:lamp:on

use std::io::{ErrorKind, Read, Write};
use std::net::TcpListener;
use std::time::Duration;

use ztl_mcu::link::Offer;
use ztl_mcu::{Component, Identity, Instant, Node, Refused, Report, Run};

/// A lamp that switches immediately, and goes out when the link is lost.
struct Lamp {
    on: bool,
}

impl Component for Lamp {
    fn offer(&self) -> Offer<'_> {
        Offer::new("lamp").with_words("on off")
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if !["on", "off"].contains(&goal) {
            why.text("lamp takes on or off");
            return Err(Refused);
        }
        Ok(())
    }

    fn start(&mut self, _now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.on = goal == "on";
        // Firmware would set a pin here.
        println!("lamp {goal}");
        Ok(())
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        report.text(if self.on { "on" } else { "off" });
        Run::Completed
    }

    fn abort(&mut self, _now: Instant) {}

    fn make_safe(&mut self, _now: Instant) {
        self.on = false;
    }
}

fn main() -> std::io::Result<()> {
    let address = std::env::args().nth(1);
    let listener = TcpListener::bind(address.as_deref().unwrap_or("127.0.0.1:7001"))?;
    println!("waiting for a gateway at tcp:{}", listener.local_addr()?);

    let identity = Identity::new("desk", "1.0.0", std::process::id());
    let mut node = Node::<_, 2, 128>::new(identity, [Lamp { on: false }]);
    let start = std::time::Instant::now();
    loop {
        let (mut stream, _) = listener.accept()?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(Duration::from_millis(5)))?;
        let mut buffer = [0; 64];
        loop {
            let now = Instant::from_micros(start.elapsed().as_micros() as u64);
            match stream.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => node.handle_bytes(now, &buffer[..count]),
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => break,
            }
            node.handle_timeout(now);
            loop {
                let count = node.poll_transmit(now, &mut buffer);
                if count == 0 || stream.write_all(&buffer[..count]).is_err() {
                    break;
                }
            }
        }
    }
}
