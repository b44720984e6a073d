//! Other servers: where they are, and by which keys they know this one.

use super::super::forward::Forward;
use super::Source;
use ztl_std::keys::{KeyError, KeyPair, PublicKey, can_encrypt};
use ztl_std::scope;
use ztl_yaml::Node;

impl<'d> Source<'d> {
    /// Where tasks are sent.
    pub(super) fn forward(&mut self, node: &'d Node) -> Option<Forward> {
        let mut fields = self.reading.fields(node, "to: tcp://HOST:PORT, scope")?;
        let to = fields.required("to", "to: tcp://10.0.0.7:12345");
        let to = to.and_then(|node| {
            let what = "an address, as tcp://10.0.0.7:12345";
            self.reading.parsed(node, what, |text| {
                let port = text
                    .strip_prefix("tcp://")
                    .and_then(|rest| rest.rsplit_once(':'));
                let port = port.filter(|(host, _)| !host.is_empty());
                match port.map(|(_, port)| port.parse::<u16>()) {
                    Some(Ok(1..)) => Ok(text.to_owned()),
                    _ => Err(format!("'{text}' is not {what}")),
                }
            })
        });
        let scope = fields.required("scope", "scope: /cob");
        let scope = scope.and_then(|node| {
            let what = "a scope, as /cob";
            self.reading.parsed(node, what, |text| {
                scope::cannot_be_asked(text).map_or_else(|| Ok(text.to_owned()), Err)
            })
        });
        let handler = fields.optional("handler");
        let handler = handler.and_then(|node| self.name(node, "a handler"));
        let component = fields.optional("component");
        let component = component.and_then(|node| self.name(node, "a component"));
        let base = self.base;
        let own = fields.optional("key");
        let server = fields.optional("server-key");
        let mut path = |node: Option<&'d Node>| {
            let text = self.reading.text(node?, "a file of `ztl keys`")?;
            Some(base.join(text))
        };
        let keys = match (path(own), path(server)) {
            (Some(own), Some(server)) => Some((own, server)),
            _ => None,
        };
        if let (Some(node), None) | (None, Some(node)) = (own, server) {
            let message =
                "an encrypted connection needs both: key: robot.key_secret, server-key: far.key";
            self.reading.wrong(node, message);
        }
        fields.finish(&mut self.reading);
        if let (Some(node), Some((own, server))) = (own, &keys) {
            let mistake = match can_encrypt() {
                true => KeyPair::read(own).err().or(PublicKey::read(server).err()),
                false => Some(KeyError::NoCurve),
            };
            if let Some(mistake) = mistake {
                self.warn(node, format!("its tasks will be refused: {mistake}"));
            }
        }
        Some(Forward {
            to: to?,
            scope: scope?,
            handler,
            component,
            keys,
        })
    }
}
