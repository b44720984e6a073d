//! Streams under load: subscribers that do not read, floods, and programs that print without end.

use super::*;

/// The readers get each block before the next ones are written, while others read nothing at all.
#[test]
fn of_twenty_subscribers_five_that_never_read_cost_the_others_nothing() {
    const BATCH: usize = 100;
    const BATCHES: usize = 20;
    const READERS: usize = 15;
    let _busy = busy();
    let python = python().display().to_string();
    let robot = Robot::new(&format!(
        "blocks: {{run: [{python}, blocks.py], frame: 20000 bytes}}"
    ));
    let script = format!(
        "
import os, time
def put(number):
    block = b'%08d' % number + b'x' * 19992
    while block:
        block = block[os.write(1, block):]
while not os.path.exists('go'):
    put(99999999)
    time.sleep(0.02) # Often enough to show that it runs.
for batch in range({BATCHES}):
    for number in range({BATCH}):
        put(batch * {BATCH} + number)
    while not os.path.exists('got%d' % batch):
        time.sleep(0.01) # Looks for the file again.
time.sleep(600) # Until the server stops it: a program that ends would be started again.
"
    );
    std::fs::write(robot.rig.scratch.path("blocks.py"), script).expect("to write");
    let context = zmq::Context::new();
    let subscribe = |most| {
        let socket = context.socket(zmq::SUB).expect("a socket");
        socket.set_rcvhwm(most).expect("a limit");
        socket.set_rcvtimeo(20_000).expect("a limit");
        socket.set_subscribe(b"/robot/blocks").expect("a topic");
        socket.connect(&robot.endpoint()).expect("an address");
        socket
    };
    let _slow: Vec<_> = (0..5).map(|_| subscribe(1)).collect();
    let readers: Vec<_> = (0..READERS).map(|_| subscribe(0)).collect();
    let process = &robot.rig.server.process;
    let [ready, got] = [0, 0].map(AtomicUsize::new);
    let before = std::thread::scope(|scope| {
        for reader in readers {
            let next = move || {
                let frames = reader.recv_multipart(0).expect("a message");
                let [topic, body] = frames.as_slice() else {
                    panic!("{} frames", frames.len());
                };
                assert_eq!(topic, b"/robot/blocks");
                let value = Pickle::read(body).expect("a pickle");
                let Kind::Bytes(block) = value.value().kind() else {
                    panic!("{value:?}");
                };
                assert!(block.len() == 20_000 && block.ends_with(b"xxx"));
                let digits = std::str::from_utf8(&block[..8]).expect("digits");
                digits.parse::<usize>().expect("a number")
            };
            let (ready, got) = (&ready, &got);
            scope.spawn(move || {
                let mut number = next();
                ready.fetch_add(1, Ordering::SeqCst);
                while number == 99_999_999 {
                    number = next();
                }
                for expected in 0..BATCH * BATCHES {
                    assert_eq!(number, expected);
                    got.fetch_add(1, Ordering::SeqCst);
                    if expected + 1 < BATCH * BATCHES {
                        number = next();
                    }
                }
            });
        }
        let reach = |count: &AtomicUsize, most| {
            until("all readers", 2 * PATIENCE, || {
                (count.load(Ordering::SeqCst) >= most).then_some(())
            });
        };
        reach(&ready, READERS);
        let before = process.resident_kib();
        robot.touch("go");
        for batch in 0..BATCHES {
            reach(&got, (batch + 1) * BATCH * READERS);
            robot.touch(&format!("got{batch}"));
        }
        before
    });
    let grown = process.resident_kib().saturating_sub(before);
    println!("40 MB for 20 subscribers: the server has grown by {grown} KiB");
    assert!(grown < 24 << 10, "{grown} KiB");
}

#[test]
fn hostile_output_takes_bounded_memory_and_delays_no_other_stream() {
    let _busy = busy();
    let robot = Robot::new(
        r#"
        endless: {shell: 'yes | tr -d "\n"', frame: line, when-watched: 60 s}
        image: {shell: 'printf "\377\330\377\332\0\2"; cat /dev/zero', frame: jpeg, when-watched: 60 s}
        noise: {shell: 'cat /dev/zero', frame: jpeg, when-watched: 60 s}
        length: {shell: 'printf "\377\377\377\377"; cat /dev/zero', frame: length, when-watched: 60 s}
        json: {shell: 'while :; do echo "{\"x\": "; printf "\377\n"; done', frame: json, when-watched: 60 s}
        tick: {shell: 'while sleep 0.02; do echo tick; done', frame: line}
        "#,
    );
    let mut tick = robot.subscribe("/robot/tick");
    assert_eq!(shown(&mut tick), "'tick'");
    let process = &robot.rig.server.process;
    let before = process.resident_kib();
    // It never reads.
    let context = zmq::Context::new();
    let all = context.socket(zmq::SUB).expect("a socket");
    all.set_rcvhwm(1).expect("a limit");
    all.set_subscribe(b"").expect("a topic");
    all.connect(&robot.endpoint()).expect("an address");
    let long = "a frame was dropped: it is longer than 4096 KiB (longest)";
    process.wait_for(&format!("Stream /robot/endless: {long}"));
    process.wait_for(&format!("Stream /robot/image: {long}"));
    process.wait_for(&format!("Stream /robot/length: {long}"));
    process.wait_for("Stream /robot/noise: a frame was dropped: it is not a JPEG image");
    process.wait_for("Stream /robot/json: a frame was dropped: it is not JSON: ");
    for _ in 0..100 {
        assert_eq!(shown(&mut tick), "'tick'");
    }
    assert_eq!(tick.missed(), 0);
    let grown = process.peak_kib().saturating_sub(before);
    println!("hostile output: the server had grown by {grown} KiB");
    assert!(grown < 96 << 10, "{grown} KiB");
    // One line in ten seconds.
    let lines = process.stderr().matches("Stream /robot/json: ").count();
    assert!(lines <= 4, "{}", process.stderr());
}

#[test]
fn a_flood_of_frames_leaves_room_for_other_streams_and_for_tasks() {
    let _busy = busy();
    let text = "scopes: {/robot: {h: {echo: echo}}}\n".to_owned()
        + &file(
            r#"
            flood: {shell: 'yes ""', frame: line, when-watched: 60 s}
            tick: {shell: 'while sleep 0.02; do echo tick; done', frame: line}
            "#,
        );
    let robot = Robot::of_file(&text, &[]);
    // So many that sending takes longer than writing.
    let _floods: Vec<_> = (0..4)
        .map(|_| {
            let mut flood = robot.subscribe("/robot/flood");
            assert_eq!(shown(&mut flood), "''");
            flood
        })
        .collect();
    let process = &robot.rig.server.process;
    let mut tick = robot.subscribe("/robot/tick");
    let mut events = robot.subscribe("/robot/$tasks");
    let mut remote = connect_to(&robot.rig.server.endpoint(), "/robot");
    // Until its subscription has arrived.
    until("an event", PATIENCE, || {
        let ended = remote.run("h", "echo", "first", Some(PATIENCE));
        assert_eq!(ended.expect("its end").text, "first");
        events.next_within(WAIT).expect("it can wait")
    });
    for number in 0..20 {
        assert_eq!(shown(&mut tick), "'tick'");
        let goal = number.to_string();
        let ended = remote.run("h", "echo", &goal, Some(PATIENCE));
        assert_eq!(ended.expect("its end").text, goal);
    }
    let last = "'text': '19'";
    until(last, PATIENCE, || {
        shown(&mut events).contains(last).then_some(())
    });
    assert_eq!((tick.missed(), events.missed()), (0, 0));
    assert!(!process.stderr().contains("were not published"));
    let held = process.peak_kib();
    println!("a flood: the server had {held} KiB");
    assert!(held < 96 << 10, "{held} KiB");
}
