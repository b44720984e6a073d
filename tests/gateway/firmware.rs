//! A simulated device in this process: the node of `ztl-mcu` with any components, at a TCP port.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_mcu::link::{Loss, Offer};
use ztl_mcu::{Component, Components, Identity, Instant, Node, Reading, Refused, Report, Run};

/// Its link timeout: no thread of a busy machine is late for so long.
const LINK_TIMEOUT: Duration = Duration::from_secs(5);

/// Runs until it is dropped.
pub(crate) struct Firmware {
    pub(crate) address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Firmware {
    pub(crate) fn start(components: impl Components + Send + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("its address");
        listener.set_nonblocking(true).expect("to be stopped");
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || run(&listener, components, &stopped));
        Self {
            address,
            stop,
            thread: Some(thread),
        }
    }
}

impl Drop for Firmware {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn run(listener: &TcpListener, components: impl Components, stop: &AtomicBool) {
    let identity = Identity {
        link_timeout: LINK_TIMEOUT,
        ..Identity::new("bench", "1.0.0", 7)
    };
    let mut node = Node::<_, 4, 700>::new(identity, components);
    let start = std::time::Instant::now();
    let mut stream = None;
    let mut buffer = [0xA5; 256];
    while !stop.load(Ordering::SeqCst) {
        if stream.is_none()
            && let Ok((new, _)) = listener.accept()
        {
            new.set_nonblocking(false).expect("a stream");
            new.set_nodelay(true).expect("a stream");
            let wait = Some(Duration::from_millis(2));
            new.set_read_timeout(wait).expect("a stream");
            stream = Some(new);
        }
        let now = Instant::from_micros(start.elapsed().as_micros() as u64);
        match stream.as_mut().map(|stream| stream.read(&mut buffer)) {
            Some(Ok(count)) if count > 0 => node.handle_bytes(now, &buffer[..count]),
            Some(Err(error))
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Some(_) => stream = None,
            None => std::thread::sleep(Duration::from_millis(2)),
        }
        node.handle_timeout(now);
        loop {
            let count = node.poll_transmit(now, &mut buffer);
            if count == 0 {
                break;
            }
            if let Some(stream) = &mut stream {
                let _ = stream.write_all(&buffer[..count]);
            }
        }
    }
}

/// Moves until it is stopped.
pub(crate) struct Endless {
    pub(crate) name: &'static str,
    pub(crate) loss: Loss,
    stopped: bool,
}

impl Endless {
    pub(crate) fn new(name: &'static str, loss: Loss) -> Self {
        Self {
            name,
            loss,
            stopped: false,
        }
    }
}

impl Component for Endless {
    fn offer(&self) -> Offer<'_> {
        Offer::new(self.name).with_words("go").with_loss(self.loss)
    }

    fn check(&self, _goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _now: Instant, _goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        self.stopped = false;
        Ok(())
    }

    fn poll(&mut self, _now: Instant, _report: &mut Report<'_>) -> Run {
        match self.stopped {
            true => Run::Aborted,
            false => Run::Running,
        }
    }

    fn abort(&mut self, _now: Instant) {
        self.stopped = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.stopped = true;
    }
}

/// Publishes repeatedly a number as text under `count` and its bytes under `raw`.
#[derive(Default)]
pub(crate) struct Counter {
    published: u32,
    due: Instant,
}

impl Component for Counter {
    fn offer(&self) -> Offer<'_> {
        Offer::new("counter").with_topics("count raw")
    }

    fn check(&self, _goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        why.text("counter only counts");
        Err(Refused)
    }

    fn start(&mut self, _now: Instant, _goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn poll(&mut self, _now: Instant, _report: &mut Report<'_>) -> Run {
        Run::Aborted
    }

    fn abort(&mut self, _now: Instant) {}

    fn make_safe(&mut self, _now: Instant) {}

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        if now < self.due {
            return None;
        }
        let number = self.published / 2;
        let topic = (self.published % 2) as u8;
        let bytes = match topic {
            0 => number.to_string().into_bytes(),
            _ => number.to_le_bytes().to_vec(),
        };
        buffer.get_mut(..bytes.len())?.copy_from_slice(&bytes);
        self.published += 1;
        self.due = now + Duration::from_millis(2);
        Some(Reading {
            topic,
            len: bytes.len(),
        })
    }
}
