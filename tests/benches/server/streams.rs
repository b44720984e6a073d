//! Publishers and subscribers, each pair in one process: ours, bare libzmq, and the original's classes.

use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::{Publisher, Subscriber};
use ztl_tests::lab::{PATIENCE, Process, python, reserve_port};

use crate::numbers::{Interval, percentile, verdict};
use crate::{Bench, ROUNDS};

/// Bytes of an image of 640 by 480 pixels in three colours.
const IMAGE: usize = 921_600;
const IMAGES: usize = 50;
/// Messages of one measurement of the rate.
const MESSAGES: u32 = 200_000;
const SMALL: [u8; 60] = [7; 60];

/// The original's publisher, in the process that measures, and its subscriber in another one. Prints
/// the p50 of images in ms, or messages a second.
const ORIGINAL: &str = r#"
import sys, time, logging, multiprocessing
logging.disable(logging.CRITICAL)

def subscribe(port, heard):
    from ztl.core.subscriber import ObjectSubscriber
    state = {"first": None, "count": 0}
    class Heard(ObjectSubscriber):
        def callback(self, obj):
            now = time.perf_counter()
            what, sent, body = obj
            if what == "image":
                heard.put(now - sent)
            elif what == "small":
                state["first"] = state["first"] or now
                state["count"] += 1
            elif what == "end":
                if state["first"]:
                    heard.put(state["count"] / (now - state["first"]))
                state["first"], state["count"] = None, 0
            else:
                heard.put("ready")
    Heard("127.0.0.1", port, "/bench").run()

if __name__ == "__main__":
    port = int(sys.argv[1])
    context = multiprocessing.get_context("fork")
    heard = context.Queue()
    subscriber = context.Process(target=subscribe, args=(port, heard), daemon=True)
    subscriber.start()
    from ztl.core.publisher import ObjectPublisher
    publisher = ObjectPublisher(port, "/bench")
    while heard.empty():
        publisher.publish(("begin", 0, None))
        time.sleep(0.01)
    time.sleep(0.5)
    while not heard.empty():
        heard.get()
    print("ready", flush=True)
    for line in sys.stdin:
        what, count = line.split()
        if what == "image":
            body, times = b"\7" * 921600, []
            for _ in range(int(count)):
                publisher.publish(("image", time.perf_counter(), body))
                times.append(heard.get())
            print(sorted(times)[len(times) // 2] * 1e3, flush=True)
        else:
            body = b"\7" * 20
            for _ in range(int(count)):
                publisher.publish(("small", 0, body))
            rate = None
            while rate is None:
                publisher.publish(("end", 0, None))
                try:
                    rate = heard.get(timeout=0.5)
                except Exception:
                    pass
            print(rate, flush=True)
"#;

/// The original's pair.
struct Original(Process);

impl Original {
    fn start() -> Self {
        loop {
            let mut command = Command::new(python());
            let port = reserve_port().to_string();
            let process = Process::start(command.args(["-c", ORIGINAL, &port]));
            if process.wait_for_unless_taken("ready").is_some() {
                return Self(process);
            }
        }
    }

    fn measure(&mut self, what: &str, count: u32) -> f64 {
        self.0.write_line(&format!("{what} {count}"));
        loop {
            let line = self.0.next_line(PATIENCE * 4);
            if line != "ready" {
                return line.parse().expect("a number");
            }
        }
    }
}

struct Ours {
    publisher: Publisher,
    subscriber: Subscriber,
}

impl Ours {
    fn start() -> Self {
        let publisher = Publisher::bind("tcp://127.0.0.1:*", "/bench").expect("a port");
        let mut subscriber = Subscriber::connect(publisher.endpoint(), "/bench").expect("a file");
        while publisher.subscribers() == 0 {
            let heard = subscriber.next_within(Duration::from_millis(10));
            assert_eq!(heard.expect("it can wait"), None);
        }
        Self {
            publisher,
            subscriber,
        }
    }

    fn image(&mut self, image: &[u8]) {
        assert!(self.publisher.publish_bytes("/image", image, false));
        let heard = self.subscriber.next_within(PATIENCE);
        let heard = heard.expect("it can wait").expect("the image");
        assert_eq!(heard.body.len(), image.len());
    }

    fn rate(&mut self) -> f64 {
        let Self {
            publisher,
            subscriber,
        } = self;
        std::thread::scope(|scope| {
            let hearing = scope.spawn(|| {
                let mut first = None;
                let mut count = 0u32;
                loop {
                    let heard = subscriber.next_within(PATIENCE);
                    let heard = heard.expect("it can wait").expect("a message");
                    let start = *first.get_or_insert_with(Instant::now);
                    if heard.topic == "/bench/end" {
                        return f64::from(count) / start.elapsed().as_secs_f64();
                    }
                    count += 1;
                }
            });
            for _ in 0..MESSAGES {
                while !publisher.publish_bytes("/small", &SMALL, false) {
                    std::thread::yield_now();
                }
            }
            while !publisher.publish_bytes("/end", b"", false) {
                std::thread::yield_now();
            }
            hearing.join().expect("no panic")
        })
    }
}

struct Libzmq {
    publisher: zmq::Socket,
    subscriber: zmq::Socket,
}

impl Libzmq {
    fn start() -> Self {
        let context = zmq::Context::new();
        let publisher = context.socket(zmq::XPUB).expect("a socket");
        // Without limits, so that it drops nothing.
        publisher.set_sndhwm(0).expect("an option");
        publisher.bind("tcp://127.0.0.1:*").expect("a port");
        let endpoint = publisher.get_last_endpoint().expect("an option");
        let subscriber = context.socket(zmq::SUB).expect("a socket");
        subscriber.set_rcvhwm(0).expect("an option");
        subscriber
            .connect(&endpoint.expect("UTF-8"))
            .expect("an address");
        subscriber.set_subscribe(b"/bench").expect("an option");
        assert_eq!(
            publisher.recv_bytes(0).expect("a subscription"),
            b"\x01/bench"
        );
        Self {
            publisher,
            subscriber,
        }
    }

    fn send(&self, topic: &str, body: &[u8]) {
        let frames = [topic.as_bytes(), body];
        self.publisher.send_multipart(frames, 0).expect("it sends");
    }

    fn image(&mut self, image: &[u8]) {
        self.send("/bench/image", image);
        let heard = self.subscriber.recv_multipart(0).expect("the image");
        assert_eq!(heard[1].len(), image.len());
    }

    fn rate(&mut self) -> f64 {
        std::thread::scope(|scope| {
            let Self {
                publisher,
                subscriber,
            } = &mut *self;
            let hearing = scope.spawn(move || {
                let mut first = None;
                let mut count = 0u32;
                loop {
                    let heard = subscriber.recv_multipart(0).expect("a message");
                    let start = *first.get_or_insert_with(Instant::now);
                    if heard[0] == b"/bench/end" {
                        return f64::from(count) / start.elapsed().as_secs_f64();
                    }
                    count += 1;
                }
            });
            for _ in 0..MESSAGES {
                let frames = [&b"/bench/small"[..], &SMALL];
                publisher.send_multipart(frames, 0).expect("it sends");
            }
            let frames = [&b"/bench/end"[..], b""];
            publisher.send_multipart(frames, 0).expect("it sends");
            hearing.join().expect("no panic")
        })
    }
}

/// The median of some images, in milliseconds.
fn images(mut image: impl FnMut(&[u8])) -> f64 {
    let body = vec![7; IMAGE];
    let mut times: Vec<f64> = (0..IMAGES)
        .map(|_| {
            let sent = Instant::now();
            image(&body);
            sent.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    percentile(&times, 50)
}

/// Images and small messages, from a publisher to a subscriber.
pub(crate) fn streams(_: &Bench) {
    let mut ours = Ours::start();
    let mut libzmq = Libzmq::start();
    let mut original = Original::start();
    let mut seen: Vec<[f64; 6]> = Vec::new();
    for _ in 0..ROUNDS {
        seen.push([
            images(|body| ours.image(body)),
            images(|body| libzmq.image(body)),
            original.measure("image", 5),
            ours.rate(),
            libzmq.rate(),
            original.measure("small", MESSAGES / 10),
        ]);
    }
    let missed = ours.publisher.missed();
    let ratio =
        |one: usize, other: usize| Interval::of(seen.iter().map(|row| row[one] / row[other]));
    let column = |place: usize| Interval::of(seen.iter().map(|row| row[place]));
    println!("An image of {IMAGE} bytes, from publisher to subscriber (p50, ms):");
    println!(
        "  ours {}, bare libzmq {}, the original {}",
        column(0),
        column(1),
        column(2)
    );
    let wanted = ratio(0, 1);
    println!(
        "  ours of bare libzmq: {wanted}; wanted at most 1.2: {}",
        verdict(wanted.stays_below(1.2))
    );
    println!("Small messages a second:");
    println!(
        "  ours {} (and {missed} missed in all), bare libzmq {}, the original {}",
        column(3),
        column(4),
        column(5)
    );
    for (other, name, least) in [(4, "bare libzmq", 0.9), (5, "the original", 5.0)] {
        let wanted = ratio(3, other);
        println!(
            "  ours of {name}: {wanted}; wanted at least {least}: {}",
            verdict(wanted.reaches(least))
        );
    }
}
