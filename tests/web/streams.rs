//! Streams of publishers, for clients of rosbridge.

use serde_json::{Value, json};
use ztl_pickle::Pickle;
use ztl_std::Publisher;
use ztl_tests::lab::{PATIENCE, until};

use crate::client::Client;
use crate::console::{Console, port, web};

#[test]
fn the_values_of_a_topic_and_the_level_of_sound() {
    let console = Console::of_one();
    let publisher = Publisher::bind("tcp://127.0.0.1:0", "/lab").expect("a publisher");
    let address = publisher.endpoint().rsplit(':').next().expect("a port");
    let (option, sound) = (
        ["--publisher", "lab", "127.0.0.1", address, "/lab"],
        ["--sound", "/lab/sound"],
    );
    let options = [option.as_slice(), &sound].concat();
    let (_process, url) = web(0, &[("ours", console.robot.port)], &options);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/streams/lab/lab/pose");
    until("a subscriber", PATIENCE, || {
        (publisher.subscribers() == 1).then_some(())
    });

    let publish =
        |path: &str, body: &Pickle| assert!(publisher.publish_bytes(path, &body.to_bytes(), true));
    publish("/pose", &Pickle::from(0.5));
    publish("/other", &Pickle::from(7.0));
    let told = client.topic("/ztl/streams/lab/lab/pose", |_| true);
    assert_eq!(
        (&told["topic"], &told["value"]),
        (&json!("/lab/pose"), &json!(0.5)),
        "{told}"
    );
    publish("/pose", &Pickle::from(1.5));
    client.topic("/ztl/streams/lab/lab/pose", |told| told["value"] == 1.5);
    // One that subscribes later gets the newest value at once; a large one is not sent.
    publish("/pose", &Pickle::bytes(&vec![7; 100_000]).expect("bytes"));
    let mut late = Client::open(port(&url));
    late.subscribe("/ztl/streams/lab/lab/pose");
    let told = late.topic("/ztl/streams/lab/lab/pose", |told| {
        told["error"].is_string()
    });
    assert!(
        told["error"]
            .as_str()
            .is_some_and(|why| why.contains("more than 65536")),
        "{told}"
    );

    // A square wave of half the full scale.
    let wave: Vec<u8> = [16_384_i16, -16_384]
        .repeat(800)
        .into_iter()
        .flat_map(i16::to_le_bytes)
        .collect();
    publish("/sound", &Pickle::bytes(&wave).expect("bytes"));
    late.subscribe("/ztl/streams/lab");
    let is_sound = |stream: &&Value| stream["topic"] == "/lab/sound";
    let heard = |told: &Value| {
        told["streams"]
            .as_array()
            .and_then(|all| all.iter().find(is_sound).cloned())
    };
    let told = late.topic("/ztl/streams/lab", |told| heard(told).is_some());
    let sound = heard(&told).expect("it was there");
    assert_eq!(sound["text"], "-6 dB of full scale", "{sound}");
    assert_eq!(sound["numbers"][0][0], "dB");

    // Without clients the console unsubscribes.
    client.unsubscribe("/ztl/streams/lab/lab/pose");
    drop(late);
    until("nobody to subscribe", PATIENCE, || {
        (publisher.subscribers() == 0).then_some(())
    });
}
