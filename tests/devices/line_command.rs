//! `ztl line`: bytes come out at the other end with the delays and faults that the options ask for.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

use ztl_std::gateway::{Endpoint, Line};
use ztl_tests::lab::{PATIENCE, Process, Scratch, in_time, until, ztl};

/// `ztl line`, ready.
#[track_caller]
fn line(args: &str) -> Process {
    let process = Process::start(ztl().arg("line").args(args.split_whitespace()));
    process.wait_for("Seed ");
    process
}

/// A line between two ports of this machine, and a stream at each end.
#[track_caller]
fn between(options: &str) -> (Process, TcpStream, TcpStream) {
    let far = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let to = far.local_addr().unwrap().port();
    let process = line(&format!("tcp-listen:0 tcp:127.0.0.1:{to} {options}"));
    let from = process.wait_for_port("A: ");
    let near = TcpStream::connect(("127.0.0.1", from)).unwrap();
    let (far, _) = far.accept().unwrap();
    for stream in [&near, &far] {
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
    }
    let mut both = (process, near, far);
    // Bytes are lost while an end is missing: both ends are connected once a byte arrives. Reads up to the last one that was
    // written, so that none arrives later.
    both.2
        .set_read_timeout(Some(Duration::from_millis(200)))
        .unwrap();
    let mut number = 0_u8;
    until("the last byte comes through", PATIENCE, || {
        number = number.wrapping_add(1);
        both.1.write_all(&[number]).unwrap();
        let mut byte = [0xA5];
        while both.2.read_exact(&mut byte).is_ok() {
            if byte == [number] {
                return Some(());
            }
        }
        None
    });
    both.2.set_read_timeout(Some(PATIENCE)).unwrap();
    both
}

fn pattern(len: usize) -> Vec<u8> {
    (0..len).map(|place| (place % 251) as u8).collect()
}

#[test]
fn each_direction_has_the_full_line_rate() {
    let (_line, mut near, mut far) = between("--baud 115200");
    let bytes = pattern(11_520);
    // 1 s at 11520 bytes a second, the other direction just as busy.
    in_time(Duration::from_millis(1100), || {
        let start = Instant::now();
        near.write_all(&bytes).unwrap();
        far.write_all(&bytes).unwrap();
        let (mut there, mut back) = (vec![0; bytes.len()], vec![0; bytes.len()]);
        far.read_exact(&mut there).unwrap();
        near.read_exact(&mut back).unwrap();
        let took = start.elapsed();
        assert_eq!((there == bytes, back == bytes), (true, true));
        assert!(took >= Duration::from_millis(990), "{took:?}");
    });
}

#[test]
fn a_lost_end_is_reopened_without_closing_the_other() {
    let scratch = Scratch::new();
    let link = scratch.path("port");
    let far = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let to = far.local_addr().unwrap().port();
    let process = line(&format!("pty:{} tcp:127.0.0.1:{to}", link.display()));
    let mut port = std::fs::File::options().write(true).open(&link).unwrap();
    for round in 1..=3u8 {
        let (mut stream, _) = far.accept().unwrap();
        stream
            .set_read_timeout(Some(Duration::from_millis(200)))
            .unwrap();
        let mut byte = [0xA5];
        until("a byte comes through", PATIENCE, || {
            port.write_all(&[round]).unwrap();
            stream.read_exact(&mut byte).ok()
        });
        assert!(byte[0] <= round, "{byte:?}");
    }
    process.signal("TERM");
    let ended = process.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
    assert!(ended.stdout.contains("\nA to B: "), "{ended:?}");
    assert!(ended.stdout.contains("\nB to A: 0 bytes"), "{ended:?}");
    assert!(!Path::new(&link).is_symlink(), "the link is left behind");
}

#[test]
fn the_same_seed_corrupts_the_same_bytes() {
    let spoilt = |seed: u32| {
        let faults = "--flip 1e-3 --drop 1e-3 --double 1e-3";
        // From B to A: no byte has gone there yet, and how many were sent from A to B depends on the machine.
        let (line, mut to, mut from) = between(&format!("{faults} --seed {seed}"));
        from.write_all(&pattern(20_000)).unwrap();
        // Marks the end: the pattern has no such byte.
        from.write_all(&[0xFF; 200]).unwrap();
        to.set_read_timeout(Some(Duration::from_millis(300)))
            .unwrap();
        let mut came = Vec::new();
        let end = until("the end has come", PATIENCE, || {
            line.signal("USR1");
            let mut piece = [0; 4096];
            let count = to.read(&mut piece).unwrap_or_default();
            came.extend_from_slice(&piece[..count]);
            came.windows(16).position(|bytes| bytes == [0xFF; 16])
        });
        came.truncate(end);
        came
    };
    let (first, again, other) = (spoilt(7), spoilt(7), spoilt(8));
    assert!(first != pattern(20_000), "nothing is corrupted");
    assert!(first == again, "another seed's bytes");
    assert!(first != other, "the same bytes");
}

#[test]
fn a_cut_in_one_direction_spares_the_other_and_ends() {
    let start = Instant::now();
    // Long enough to write the first bytes during the cut.
    let (line, mut near, mut far) = between("--cut to-a --cut-for 10s");
    far.write_all(b"lost").unwrap();
    near.write_all(b"heard").unwrap();
    let mut heard = [0; 5];
    far.read_exact(&mut heard).unwrap();
    assert_eq!(&heard, b"heard");
    let mut byte = [0xA5];
    near.set_read_timeout(Some(Duration::from_millis(50)))
        .unwrap();
    until("the cut has ended", PATIENCE, || {
        far.write_all(b"x").unwrap();
        near.read_exact(&mut byte).ok()
    });
    assert_eq!(&byte, b"x");
    assert!(start.elapsed() >= Duration::from_secs(10));
    line.signal("USR1");
    let counts = line.wait_for("B to A: ");
    assert!(!counts.contains(" 0 cut off"), "{counts}");
}

#[test]
fn a_usage_error_is_one_line_with_the_expected_form() {
    let taken = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let taken = format!("tcp-listen:{}", taken.local_addr().unwrap().port());
    for (args, code, part) in [
        ("/dev/ttyACM0 pty", 2, "serial:/dev/ttyACM0"),
        ("tcp:7000 pty", 2, "tcp-listen:PORT to listen"),
        ("pty pty --flip 2", 2, "a number from 0 to 1"),
        (
            "pty pty --for 10",
            2,
            "10' for '--for <TIME>': expected a number with a unit",
        ),
        ("pty pty --baud 0", 2, "0 is not in 1.."),
        ("pty:/nowhere/link pty", 1, "cannot make the link /nowhere"),
        (&format!("pty {taken}"), 1, "cannot listen at 127.0.0.1:"),
    ] {
        let ended = Process::run(ztl().arg("line").args(args.split_whitespace()));
        assert_eq!(ended.code, Some(code), "{args}: {ended:?}");
        assert!(ended.stderr.contains(part), "{args}: {ended:?}");
    }
    let ended = Process::run(ztl().args(["line", "pty", "pty", "--for", "100ms"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

/// Reads until this many bytes have arrived.
#[track_caller]
fn hears(line: &mut Line, count: usize) -> Vec<u8> {
    let mut all = Vec::new();
    until("all bytes", PATIENCE, || {
        let mut piece = [0xA5; 4096];
        // Times out after some milliseconds.
        if let Ok(some) = line.reader.read(&mut piece) {
            all.extend_from_slice(&piece[..some]);
        }
        (all.len() >= count).then_some(())
    });
    all
}

/// How many bytes have collided so far.
#[track_caller]
fn collided(line: &Process) -> u32 {
    let before = line.stdout().len();
    line.signal("USR1");
    until("the counts", PATIENCE, || {
        let printed = line.stdout();
        let mut lines = printed[before..].lines();
        let count = lines.find_map(|line| line.strip_suffix(" bytes collided"))?;
        count.parse().ok()
    })
}

/// Reads until nothing has arrived for a while.
fn heard(line: &mut Line) -> Vec<u8> {
    let mut all = Vec::new();
    let mut last = Instant::now();
    while last.elapsed() < Duration::from_millis(500) {
        let mut piece = [0xA5; 4096];
        // Times out after some milliseconds.
        if let Ok(count) = line.reader.read(&mut piece) {
            all.extend_from_slice(&piece[..count]);
            last = Instant::now();
        }
    }
    all
}

#[test]
fn ends_of_a_half_duplex_line_that_send_at_once_damage_each_other() {
    let scratch = Scratch::new();
    let links = ["a", "b", "c"].map(|name| scratch.path(name).display().to_string());
    let ends = links.each_ref().map(|link| format!("pty:{link}"));
    let process = line(&format!("--half-duplex --baud 9600 {}", ends.join(" ")));
    let mut ports = links.map(|link| {
        let end: Endpoint = format!("serial:{link}").parse().unwrap();
        end.open().unwrap()
    });
    // Bytes to an end that the line has not opened yet are lost. Reads up to the last one that was written, so that none arrives
    // later.
    let mut number = 0_u8;
    until("each end hears the first one", PATIENCE, || {
        number = number.wrapping_add(1);
        ports[0].writer.write_all(&[number]).unwrap();
        let heard = [heard(&mut ports[1]), heard(&mut ports[2])];
        let has_last = |heard: &Vec<u8>| heard.last() == Some(&number);
        heard.iter().all(has_last).then_some(())
    });
    let bytes = pattern(200);
    ports[0].writer.write_all(&bytes).unwrap();
    assert_eq!(hears(&mut ports[1], bytes.len()), bytes);
    assert_eq!(hears(&mut ports[2], bytes.len()), bytes);
    for port in &mut ports {
        assert_eq!(heard(port), b"", "an end hears itself, or too much");
    }
    // Each takes 0.4 s, so that they overlap unless the machine stalls between them.
    let bytes = pattern(400);
    until("they damage each other", PATIENCE, || {
        ports[1].writer.write_all(&bytes).unwrap();
        ports[2].writer.write_all(&bytes).unwrap();
        let noise = heard(&mut ports[0]);
        let both = noise.iter().zip(&bytes);
        let intact = both.filter(|(heard, sent)| heard == sent).count();
        let collided = collided(&process);
        println!(
            "{} bytes, {intact} intact, {collided} collided so far",
            noise.len()
        );
        ((1..600).contains(&noise.len()) && intact < 200 && collided > 400).then_some(())
    });
    process.signal("TERM");
    let ended = process.end(PATIENCE);
    assert!(ended.stdout.contains("\nto C: "), "{ended:?}");
    assert!(ended.stdout.ends_with(" bytes collided\n"), "{ended:?}");
}

#[test]
fn a_third_end_needs_a_half_duplex_line() {
    let run = ztl().args(["line", "pty", "pty", "pty"]).output().unwrap();
    let text = String::from_utf8_lossy(&run.stderr).into_owned();
    assert_eq!(run.status.code(), Some(2), "{text}");
    assert!(text.contains("--half-duplex"), "{text}");
}
