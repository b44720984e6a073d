//! How the parts of a fleet reach each other: addresses of routers, and certificates.

use std::path::{Path, PathBuf};

use ztl_std::listen::one_or_more;
use ztl_yaml::{Diagnostic, Fields, Node, Reading};

use super::keys;
use crate::tls::{self, Tls, Usage};

/// How to reach the other parts of the fleet.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Links {
    /// Routers to connect to, as `tcp/10.0.0.1:7447`.
    pub routers: Vec<String>,
    /// Where a router listens.
    pub listen: Vec<String>,
    /// Certificates, if there is TLS.
    pub tls: Option<Tls>,
    /// The mistake that the certificate is not valid now. The clock of this machine may be wrong, so that it is used anyway.
    pub misdated: Option<Diagnostic>,
}

/// What an address is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Use {
    Connect,
    Listen,
}

impl Use {
    const fn what(self) -> &'static str {
        match self {
            Self::Connect => {
                "a router's address, as tcp/10.0.0.1:7447 or tls/router.example.org:7447"
            }
            Self::Listen => "where to listen, as tcp/0.0.0.0:7447",
        }
    }
}

impl Links {
    /// Reads them from the file of a router, or of what connects to one.
    pub(super) fn read<'d>(
        reading: &mut Reading<'d>,
        fields: &mut Fields<'d>,
        base: &Path,
        is_router: bool,
    ) -> Self {
        let routers = match is_router {
            true => fields.optional("routers"),
            false => fields.required("routers", "routers: [tcp/10.0.0.1:7447]"),
        };
        let listen = match is_router {
            true => fields.required("listen", "listen: [tcp/0.0.0.0:7447]"),
            false => None,
        };
        let needed = match is_router {
            true => listen,
            false => routers,
        };
        if let Some(node) = needed.filter(|node| one_or_more(node).is_empty()) {
            let what = match is_router {
                true => Use::Listen.what(),
                false => Use::Connect.what(),
            };
            reading.wrong(node, format!("the list is empty; write {what}"));
        }
        // A forgotten value must not leave it out.
        let tls = fields.present("tls");
        let mut links = Self {
            routers: addresses(reading, routers, Use::Connect, tls.is_some()),
            listen: addresses(reading, listen, Use::Listen, tls.is_some()),
            ..Self::default()
        };
        if let Some(node) = tls {
            links.tls = links.read_tls(reading, node, base);
        }
        links
    }

    fn read_tls<'d>(
        &mut self,
        reading: &mut Reading<'d>,
        node: &'d Node,
        base: &Path,
    ) -> Option<Tls> {
        let what = "certificates: ca: ca.pem, certificate: arm.pem, key: arm.key.pem";
        let mut fields = reading.fields(node, what)?;
        let ca = fields.required("ca", "ca: ca.pem");
        let certificate = fields.required("certificate", "certificate: arm.pem");
        let key = fields.required("key", "key: arm.key.pem");
        fields.finish(reading);
        let ca = ca.and_then(|node| pem(reading, node, base, tls::authorities));
        let certificate =
            certificate.and_then(|node| Some((node, pem(reading, node, base, tls::certificates)?)));
        let key = key.and_then(|node| Some((node, pem(reading, node, base, tls::private_key)?)));
        if let Some((_, (path, _))) = &key {
            keys::warn_if_exposed(path);
        }
        if let (Some((_, (_, chain))), Some((node, (_, key)))) = (&certificate, &key)
            && let Err(mistake) = tls::belongs(key, chain)
        {
            reading.wrong(node, mistake);
        }
        let usage = Usage {
            connects: !self.routers.is_empty(),
            listens: !self.listen.is_empty(),
        };
        if let (Some((_, roots)), Some((node, (_, chain)))) = (&ca, &certificate) {
            match tls::check(chain, roots, usage) {
                Ok(None) => {}
                Ok(Some(dates)) => self.misdated = Some(reading.mistake(node, dates)),
                Err(mistake) => reading.wrong(node, mistake),
            }
        }
        Some(Tls {
            ca: ca?.0,
            certificate: certificate?.1.0,
            key: key?.1.0,
        })
    }
}

/// A file in PEM, and what is in it.
fn pem<'d, T>(
    reading: &mut Reading<'d>,
    node: &'d Node,
    base: &Path,
    read: impl FnOnce(&Path) -> Result<T, String>,
) -> Option<(PathBuf, T)> {
    reading.parsed(node, "a file in PEM", |text| {
        let path = base.join(text);
        let read = read(&path)?;
        // Zenoh does not know what paths are relative to.
        let path = path.canonicalize().map_err(|error| error.to_string())?;
        Ok::<_, String>((path, read))
    })
}

/// The addresses in a list; either all are over TLS, or none.
fn addresses<'d>(
    reading: &mut Reading<'d>,
    node: Option<&'d Node>,
    of: Use,
    has_tls: bool,
) -> Vec<String> {
    let mut all = Vec::new();
    for node in node.map_or(&[][..], one_or_more) {
        let address = reading.parsed(node, of.what(), |text| {
            address(text, of).map(|()| text.to_owned())
        });
        let Some(address) = address else { continue };
        match (address.strip_prefix("tcp/"), has_tls) {
            (Some(place), true) => reading.wrong(
                node,
                format!("{address} is not encrypted, although the file has 'tls'; write tls/{place}, or leave out 'tls'"),
            ),
            (None, false) => reading.wrong(
                node,
                format!("{address} needs certificates; write tls: {{ca: ca.pem, certificate: arm.pem, key: arm.key.pem}}"),
            ),
            _ => {}
        }
        all.push(address);
    }
    all
}

fn address(text: &str, of: Use) -> Result<(), String> {
    let odd = || format!("'{text}' is not {}", of.what());
    let (protocol, place) = text.split_once('/').ok_or_else(odd)?;
    let (host, port) = match place.rsplit_once(':') {
        Some((host, port)) => (host, port.parse::<u16>().ok()),
        None => (place, None),
    };
    if !["tcp", "tls"].contains(&protocol) || host.is_empty() || host.contains(['?', '#', '/']) {
        return Err(odd());
    }
    match (host, port) {
        ("*", _) if of == Use::Listen => Err(format!(
            "'{text}': '*' is not an address; for every address of this machine, write {protocol}/0.0.0.0:7447"
        )),
        ("*", _) | (_, None) => Err(odd()),
        (_, Some(0)) => Err(format!(
            "'{text}': port 0 stands for any port, and others must know it; write {protocol}/{host}:7447"
        )),
        _ => Ok(()),
    }
}
