//! Connections to the node's ports that are not those of nodes.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;

use ztl_ros1::xmlrpc::Value;
use ztl_tests::lab::PATIENCE;

use crate::rig::{Master, string, unique};

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
    crate::rig::wait("it is registered", || {
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
            stream.write_all(bytes).unwrap();
            stream.shutdown(std::net::Shutdown::Write).unwrap();
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
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
