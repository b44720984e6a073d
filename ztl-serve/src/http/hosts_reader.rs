//! Reads `http` at the top of the file.

use ztl_yaml::{Node, NodeValue};

use super::hosts::{Host, mistake};
use super::tls::Trust;
use crate::reader::ConfigReader;

impl<'d> ConfigReader<'d> {
    /// Reads `http` at the top.
    pub(crate) fn http_hosts(&mut self, node: &'d Node) {
        for (name, host) in self.non_empty(node, "hosts, as robot: 10.0.0.7") {
            let name = self.yaml.parsed(name, "a name, as robot", |text| {
                let fits = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
                match !text.is_empty() && text.chars().all(fits) {
                    true => Ok(text.to_owned()),
                    false => Err(format!("'{text}' is not a name, as robot")),
                }
            });
            let host = self.http_host_entry(host);
            if let Some(name) = name {
                // What is wrong with it is told once, and not of each address with it.
                self.http.insert(name, host.unwrap_or_default());
            }
        }
    }

    /// Reads a host, alone or with its certificate.
    fn http_host_entry(&mut self, node: &'d Node) -> Option<Host> {
        let mut certificate = None;
        let address = match &node.value {
            NodeValue::Map(_) => {
                let what = "host: 10.0.0.7, certificate: robot.pem";
                let mut fields = self.yaml.fields(node, what)?;
                let host = fields.required("host", "host: 10.0.0.7");
                certificate = fields.optional("certificate");
                fields.finish(&mut self.yaml);
                host?
            }
            _ => node,
        };
        let address = self.yaml.parsed(address, "a host, as 10.0.0.7", |text| {
            mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
        });
        let trust = certificate.map(|node| {
            let what = "a PEM file with the robot's certificate, or that of its authority";
            let base = self.base;
            self.yaml
                .parsed(node, what, |file| Trust::pinned(&base.join(file)))
        });
        Some(Host {
            address: address?,
            trust: match trust {
                Some(trust) => Some(trust?),
                None => None,
            },
        })
    }
}
