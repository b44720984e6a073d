//! The API that each node offers to the master and to other nodes.

use std::sync::Arc;
use std::time::Instant;

use super::engine::registrar::uris;
use super::engine::{Engine, IDLE, Role};
use super::net::ConnectionId;
use crate::http;
use crate::xmlrpc::{self, Value};

impl Engine {
    pub(crate) fn on_api_bytes(
        &mut self,
        now: Instant,
        id: ConnectionId,
        mut reader: http::Reader,
        bytes: &[u8],
    ) -> Option<Role> {
        reader.handle_bytes(bytes);
        self.net.set_deadline(id, Some(now + IDLE));
        loop {
            match reader.poll_message(false) {
                Ok(None) => return Some(Role::ApiCaller(reader)),
                Ok(Some(message)) => {
                    let answer = match xmlrpc::parse_call(&message.body) {
                        Ok((method, params)) => self.answer(now, &method, &params),
                        Err(error) => xmlrpc::fault(&error.to_string()),
                    };
                    let response = http::response(&answer, message.close);
                    // Who sends calls and reads no answers loses answers.
                    self.net.send(id, Arc::from(response), 16);
                    if message.close {
                        self.net.close_when_sent(now, id);
                        return None;
                    }
                }
                Err(error) => {
                    tracing::debug!(peer = self.net.peer(id), %error, "a call to the ROS node");
                    self.net.close(id);
                    return None;
                }
            }
        }
    }

    /// Answers a call.
    fn answer(&mut self, now: Instant, method: &str, params: &[Value]) -> String {
        let text = |index: usize| {
            params
                .get(index)
                .and_then(Value::as_str)
                .unwrap_or_default()
        };
        let value = match method {
            "getPid" => Value::Int(std::process::id().into()),
            "getMasterUri" => self.master[..].into(),
            "getSubscriptions" => {
                let all = self.subscriptions.iter();
                Value::Array(all.map(|(topic, of)| pair(topic, &of.ty.name)).collect())
            }
            "getPublications" => {
                let all = self.publications.iter();
                Value::Array(all.map(|(topic, of)| pair(topic, &of.ty.name)).collect())
            }
            "getBusInfo" => Value::Array(self.bus_info()),
            "getBusStats" => Value::Array(vec![Value::Array(Vec::new()); 3]),
            "publisherUpdate" => {
                let publishers = params.get(2).map(uris).unwrap_or_default();
                self.on_publishers(now, text(1), &publishers);
                Value::Int(0)
            }
            "paramUpdate" => Value::Int(0),
            "requestTopic" => {
                let topic = text(1);
                if !self.publications.contains_key(topic) {
                    return refusal(&format!("{} does not publish {topic}", self.name));
                }
                let port = Value::Int(self.tcpros_port.into());
                Value::Array(vec!["TCPROS".into(), self.host[..].into(), port])
            }
            "shutdown" => {
                // Its owner decides when it ends.
                let (by, reason) = (text(0), text(1));
                if !std::mem::replace(&mut self.is_shutdown_told, true) {
                    tracing::warn!(
                        "ignored a request of {by} to stop the ROS node, and will not say so again: {reason}"
                    );
                }
                Value::Int(0)
            }
            _ => return xmlrpc::fault(&format!("unknown method '{method}'")),
        };
        xmlrpc::response(&Value::Array(vec![Value::Int(1), "".into(), value]))
    }

    /// Who is connected: number, other end, direction, protocol, topic, and that it is connected.
    fn bus_info(&self) -> Vec<Value> {
        let row = |index: usize, peer: &str, direction: &str, topic: &str| {
            let number = Value::Int(i64::try_from(index).unwrap_or_default());
            let words = [peer, direction, "TCPROS", topic].map(Value::from);
            let mut row = vec![number];
            row.extend(words);
            row.push(Value::Bool(true));
            Value::Array(row)
        };
        let mut rows = Vec::new();
        for (topic, publication) in &self.publications {
            for caller in publication.subscribers.values() {
                rows.push(row(rows.len(), caller, "o", topic));
            }
        }
        for (topic, subscription) in &self.subscriptions {
            for uri in subscription.connected_uris() {
                rows.push(row(rows.len(), uri, "i", topic));
            }
        }
        rows
    }
}

fn pair(topic: &str, type_name: &str) -> Value {
    Value::Array(vec![topic.into(), type_name.into()])
}

fn refusal(reason: &str) -> String {
    xmlrpc::response(&Value::Array(vec![
        Value::Int(0),
        reason.into(),
        Value::Int(0),
    ]))
}
