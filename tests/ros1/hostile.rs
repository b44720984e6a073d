//! Connections to the node's ports that are not those of nodes.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use ztl_ros1::Pace;
use ztl_ros1::xmlrpc::Value;
use ztl_tests::lab::PATIENCE;

use crate::rig::{Master, listen, string, subscription, text, unique, wait};

/// The address of the node's API, and the ports of the API and of TCPROS.
fn ports(node: &ztl_ros1::Node, topic: &str) -> (String, [u16; 2]) {
    let uri = node
        .ask_master("lookupNode", &[node.name().into()])
        .unwrap();
    let uri = uri.as_str().unwrap().to_owned();
    let api = uri
        .trim_end_matches('/')
        .rsplit(':')
        .next()
        .unwrap()
        .parse()
        .unwrap();
    let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
    let offer = node
        .ask(&uri, "requestTopic", &[topic.into(), protocols])
        .unwrap();
    let tcpros = offer.as_array().unwrap()[2].as_int().unwrap();
    (uri, [api, u16::try_from(tcpros).unwrap()])
}

#[test]
fn garbage_and_a_thousand_idle_connections_lock_nobody_out() {
    let master = Master::shared();
    let node = master.node();
    let topic = unique("/target");
    let _publisher = node.publisher(&topic, string(), false).unwrap();
    wait("it is registered", || {
        node.ask_master("lookupNode", &[node.name().into()]).is_ok()
    });
    let (uri, ports) = ports(&node, &topic);
    let post = |rest: &str| format!("POST / HTTP/1.1\r\n{rest}").into_bytes();
    let deep = "<value><array><data>".repeat(5000);
    let call = format!("<methodCall><methodName>x</methodName><params><param>{deep}");
    let closed: [&[u8]; 6] = [
        b"GET / HTTP/1.1\r\n\r\n",
        &[0xff; 40],
        b"\x04\0\0\0\x09\0\0\0",
        &post("Content-Length: 99999999\r\n\r\n"),
        &post("Transfer-Encoding: chunked\r\n\r\n"),
        &post(&format!(
            "Connection: close\r\nContent-Length: {}\r\n\r\n{call}",
            call.len()
        )),
    ];
    for port in ports {
        for bytes in closed {
            let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
            // It may be closed already.
            let sent = stream.write_all(bytes);
            let _ = sent.and_then(|()| stream.shutdown(std::net::Shutdown::Write));
            let end = stream.read_to_end(&mut Vec::new());
            let late = end.is_err_and(|error| error.kind() == ErrorKind::WouldBlock);
            assert!(!late, "open after {bytes:?}");
            assert!(node.ask(&uri, "getPid", &[]).is_ok());
        }
    }
    let idle: Vec<_> = (0..1000)
        .map(|number| TcpStream::connect(("127.0.0.1", ports[number % 2])))
        .collect();
    assert!(node.ask(&uri, "getPid", &[]).is_ok());
    drop(idle);
}

#[test]
fn a_crowd_of_subscribers_does_not_push_out_the_first() {
    let master = Master::shared();
    let node = master.node();
    let topic = unique("/crowded");
    let limit = Duration::from_secs(60);
    let publisher = node.command_publisher(&topic, string(), limit, false);
    let publisher = publisher.unwrap();
    let mut base = listen(&node, node.name(), &topic, "/base");
    wait("it is connected", || publisher.subscribers() == ["/base"]);
    let (_, [_, port]) = ports(&node, &topic);
    let header = subscription(&topic, "/other");
    let other = |_| {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        // It may be closed already.
        let _ = stream.write_all(&header);
        stream
    };
    let mut crowd: Vec<TcpStream> = (0..600).map(other).collect();
    wait("there is a crowd", || publisher.subscribers().len() > 500);
    crowd.extend((0..50).map(other));
    let nodes = publisher.subscribers();
    assert!(nodes.contains(&"/base".to_owned()), "{}", nodes.len());
    publisher.publish(text("here"));
    base.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut message = [0; 12];
    base.read_exact(&mut message).unwrap();
    assert!(message.ends_with(b"here"));
    drop(crowd);
}

/// The number of threads of this process with this name.
fn threads(name: &str) -> usize {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap();
    let names = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("comm")));
    names
        .filter(|found| found.as_ref().is_ok_and(|found| found.trim() == name))
        .count()
}

#[test]
fn a_thousand_named_publishers_take_few_threads_and_the_true_one_is_heard() {
    let master = Master::shared();
    let [node, other] = [master.node(), master.node()];
    let topic = unique("/named");
    let publisher = node.publisher(&topic, string(), false).unwrap();
    wait("it is registered", || {
        node.ask_master("lookupNode", &[node.name().into()]).is_ok()
    });
    let (uri, _) = ports(&node, &topic);
    let (told, heard) = channel();
    let _subscription = node.subscribe(&topic, string(), Pace::Irregular, move |_, _| {
        let _ = told.send(());
    });
    let names: Vec<Value> = (0..1000)
        .map(|number| {
            format!("http://no-such-host-{number}.invalid:9")
                .as_str()
                .into()
        })
        .collect();
    let update = |names: Vec<Value>| {
        let params = [topic[..].into(), Value::Array(names)];
        other.ask(&uri, "publisherUpdate", &params).unwrap();
    };
    update(names);
    for _ in 0..20 {
        assert!(other.ask(&uri, "getPid", &[]).is_ok());
        let threads = threads("ztl-lookup");
        assert!(threads <= 40, "{threads} threads");
    }
    update(vec![uri[..].into()]);
    wait("the true publisher is heard", || {
        publisher.publish(text("here"));
        heard.try_recv().is_ok()
    });
}

/// A master that takes every registration and never knows the node.
fn forgetful_master(listener: &TcpListener, on_call: impl Fn(&str)) {
    for stream in listener.incoming() {
        let mut stream = stream.unwrap();
        let mut call = String::new();
        let mut piece = [0; 4096];
        while !call.contains("</methodCall>") {
            let count = stream.read(&mut piece).unwrap();
            call.push_str(&String::from_utf8_lossy(&piece[..count]));
        }
        let name = call.split("<methodName>").nth(1).unwrap();
        let name = name.split('<').next().unwrap();
        on_call(name);
        let (code, value) = match name {
            "registerPublisher" => (1, "<array><data></data></array>"),
            _ => (-1, "<int>0</int>"),
        };
        let body = format!(
            "<?xml version='1.0'?><methodResponse><params><param><value><array><data><value><int>{code}</int></value>\
             <value><string>x</string></value><value>{value}</value></data></array></value></param></params></methodResponse>"
        );
        let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", body.len());
        stream.write_all((head + &body).as_bytes()).unwrap();
    }
}

#[test]
fn a_master_that_never_knows_the_node_is_asked_once_a_second() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let config = ztl_ros1::Config {
        master: format!("http://{}", listener.local_addr().unwrap()),
        host: Some("127.0.0.1".to_owned()),
        name: "ztl".to_owned(),
    };
    let (told, calls) = channel();
    std::thread::spawn(move || {
        forgetful_master(&listener, |name| {
            let _ = told.send((name == "lookupNode", Instant::now()));
        });
    });
    let node = ztl_ros1::Node::start(&config).unwrap();
    let _publisher = node.publisher("/x", string(), false).unwrap();
    let mut checks = std::iter::from_fn(|| calls.recv_timeout(PATIENCE).ok())
        .filter_map(|(is_check, at)| is_check.then_some(at));
    let (first, fourth) = (checks.next().unwrap(), checks.nth(2).unwrap());
    assert!(fourth - first > Duration::from_secs(2));
}
