//! The types that nodes really use: their MD5 sums stand in the headers of their connections.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use crate::node::{Node, read_offer, resolve};
use crate::tcpros::{Frames, Header, LONGEST_HEADER};
use crate::uri::Address;
use crate::xmlrpc::Value;
use crate::{Survey, WireType};

/// How long each step may take.
const ANSWER: Duration = Duration::from_secs(2);

/// A timeout of zero would be none.
const TICK: Duration = Duration::from_millis(1);

impl Node {
    /// The type that a topic really has, asked of the first of its publishers that answers. Blocks for up to some
    /// seconds for each that does not. Nothing is received.
    #[must_use]
    pub fn topic_type(&self, survey: &Survey, topic: &str) -> Option<WireType> {
        let name = survey.topics.get(topic)?;
        let publishers = survey.publishers.get(topic)?;
        publishers.iter().find_map(|publisher| {
            let (uri, wrong) = survey.nodes.get(publisher)?;
            if wrong.is_some() {
                return None;
            }
            let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
            let offer = self.ask(uri, "requestTopic", &[topic.into(), protocols]);
            let address = read_offer(&offer.ok()?)?;
            let fields = [
                ("callerid", self.name()),
                ("topic", topic),
                ("type", name),
                ("md5sum", "*"),
                ("message_definition", ""),
            ];
            ask_type(&address, &fields)
        })
    }

    /// The type that a service really has. Blocks for up to some seconds if it does not answer. Calls nothing.
    #[must_use]
    pub fn service_type(&self, service: &str) -> Option<WireType> {
        let uri = self.ask_master("lookupService", &[service.into()]).ok()?;
        let address = Address::parse(uri.as_str()?, "rosrpc")?;
        let fields = [
            ("callerid", self.name()),
            ("service", service),
            ("md5sum", "*"),
            ("probe", "1"),
        ];
        ask_type(&address, &fields)
    }
}

/// Sends a header, and reads the type from that of the answer.
fn ask_type(address: &Address, fields: &[(&str, &str)]) -> Option<WireType> {
    let resolved = (resolve(&address.host)?, address.port).into();
    let mut stream = TcpStream::connect_timeout(&resolved, ANSWER).ok()?;
    stream.set_write_timeout(Some(ANSWER)).ok()?;
    let header = Header::new(fields.iter().copied());
    stream.write_all(&header.encode()).ok()?;
    let mut frames = Frames::default();
    let mut buffer = [0; 4096];
    let end = Instant::now() + ANSWER;
    let answer = loop {
        let left = end.checked_duration_since(Instant::now())?;
        stream.set_read_timeout(Some(left.max(TICK))).ok()?;
        let count = stream.read(&mut buffer).ok()?;
        if count == 0 {
            return None;
        }
        frames.handle_bytes(buffer.get(..count)?);
        if let Some(content) = frames.poll_frame(LONGEST_HEADER).ok()? {
            break Header::parse(content).ok()?;
        }
    };
    let of = |name: &str| Some(answer.get(name).to_owned()).filter(|value| !value.is_empty());
    Some(WireType {
        name: of("type")?,
        md5: of("md5sum")?,
        definition: answer.get("message_definition").to_owned(),
    })
}
