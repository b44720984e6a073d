//! A gateway's configuration file, described in `docs/gateway.md`.

use std::path::{Path, PathBuf};

use super::endpoint::{BAUD_WANTED, Endpoint, ParseEndpoint};
use super::reading_value::{READING_FORMATS, ReadingFormat};
use crate::listen::Listen;
use crate::scope;
use ztl_yaml::{Diagnostic, Document, Node, NodeValue, Reading};

/// The settings in a file. Each can be left out and be given elsewhere.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Config {
    /// Scope to serve, such as `/lab`.
    pub scope: Option<String>,
    /// The settings that every server has.
    pub listen: Listen,
    /// How readings are published.
    pub publish_format: Option<ReadingFormat>,
    /// Location of the journal.
    pub journal: Option<JournalPlace>,
    /// The devices in the file's order.
    pub devices: Vec<DeviceConfig>,
}

/// Location of the journal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum JournalPlace {
    /// No journal.
    Off,
    /// This file, or a file chosen by the gateway in this directory.
    At(PathBuf),
}

/// A device in a configuration file.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct DeviceConfig {
    /// Its name for clients.
    pub name: String,
    /// Its endpoint.
    pub endpoint: Endpoint,
    /// Its firmware's ELF file, to decode its log.
    pub elf: Option<PathBuf>,
}

impl DeviceConfig {
    /// A device without an ELF file.
    #[must_use]
    pub fn new(name: &str, endpoint: Endpoint) -> Self {
        Self {
            name: name.to_owned(),
            endpoint,
            elf: None,
        }
    }
}

impl Config {
    /// Reads a document; paths are relative to `base`. Returns what could be read, which must not be served if
    /// anything is wrong, and all mistakes, each with its place.
    #[must_use]
    pub fn read(
        document: &Document,
        base: &Path,
        endpoint: ParseEndpoint,
    ) -> (Option<Self>, Vec<Diagnostic>) {
        let mut reading = document.reading();
        let config = config(&mut reading, document.root(), base, endpoint);
        reading.into_parts(config)
    }
}

fn config<'d>(
    reading: &mut Reading<'d>,
    root: &'d Node,
    base: &Path,
    endpoint: ParseEndpoint,
) -> Option<Config> {
    let mut fields = reading.fields(root, "scope, port, devices")?;
    let mut config = Config::default();
    if let Some(node) = fields.optional("scope") {
        config.scope = reading.parsed(node, "a scope, as /lab", |text| {
            scope::cannot_be_served(text).map_or_else(|| Ok(text.to_owned()), Err)
        });
    }
    config.listen = Listen::read(reading, &mut fields, base);
    if let Some(node) = fields.optional("publish-format") {
        config.publish_format = reading.one_of(node, &READING_FORMATS);
    }
    if let Some(node) = fields.optional("journal") {
        let what = "a file or a directory, or off";
        config.journal = reading.parsed(node, what, |text| match text {
            "" => {
                Err("the name of the journal is empty; write a file, a directory or off".to_owned())
            }
            "off" | "no" | "false" => Ok(JournalPlace::Off),
            place => Ok(JournalPlace::At(base.join(place))),
        });
    }
    if let Some(node) = fields.optional("devices") {
        let what = "the name of each device and where it is, as gripper: serial:/dev/ttyACM0";
        for (name, node) in reading.pairs(node, what).unwrap_or_default() {
            let read = device(reading, name, node, base, endpoint);
            let Some((device, url)) = read else { continue };
            if let Some(other) = same_line(&config.devices, &device) {
                let message = format!("'{}' is at {} already", other.name, other.endpoint);
                reading.wrong(url, message);
            }
            config.devices.push(device);
        }
    }
    fields.finish(reading);
    Some(config)
}

/// A device, and the node of its URL.
fn device<'d>(
    reading: &mut Reading<'d>,
    name: &'d Node,
    node: &'d Node,
    base: &Path,
    endpoint: ParseEndpoint,
) -> Option<(DeviceConfig, &'d Node)> {
    let known = reading.parsed(name, "a device's name", |text| {
        name_mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
    });
    let what = "where the device is, as serial:/dev/ttyACM0";
    let mut baud = None;
    let mut elf = None;
    let url = match &node.value {
        NodeValue::Map(_) => {
            let mut fields = reading.fields(node, "url, baud, elf")?;
            let url = fields.required("url", "url: serial:/dev/ttyACM0");
            baud = fields.optional("baud");
            elf = fields.optional("elf");
            fields.finish(reading);
            url
        }
        _ => Some(node),
    }?;
    let mut endpoint = reading.parsed(url, what, endpoint);
    if let Some(node) = baud {
        let rate = reading.parsed(node, BAUD_WANTED, |text| {
            let rate = text.parse().ok().filter(|rate| *rate > 0);
            rate.ok_or_else(|| format!("'{text}' is not {BAUD_WANTED}"))
        });
        if let (Some(endpoint), Some(rate)) = (&mut endpoint, rate)
            && !endpoint.set_baud(rate)
        {
            reading.wrong(node, "only a serial port has a line rate");
        }
    }
    let mut path = None;
    if let Some(node) = elf {
        if matches!(endpoint, Some(Endpoint::Bus { .. })) {
            reading.wrong(node, BUS_HAS_NO_FIRMWARE);
        }
        path = reading.parsed(node, "the firmware's ELF file", |text| {
            let path = base.join(text);
            match path.is_file() {
                true => Ok(path),
                false => Err(format!("there is no file {}", path.display())),
            }
        });
    }
    let device = DeviceConfig {
        name: known?,
        endpoint: endpoint?,
        elf: path,
    };
    Some((device, url))
}

/// Why a shared line has no ELF file.
pub const BUS_HAS_NO_FIRMWARE: &str = "a shared line has no firmware of its own";

/// The device that uses the same line.
#[must_use]
pub fn same_line<'a>(devices: &'a [DeviceConfig], new: &DeviceConfig) -> Option<&'a DeviceConfig> {
    let shared = |device: &&DeviceConfig| device.endpoint.is_same_line(&new.endpoint);
    devices.iter().find(shared)
}

/// Why a device's name is invalid. It is part of tasks (`name:component:goal`) and topics
/// (`name/component/topic`).
#[must_use]
pub fn name_mistake(name: &str) -> Option<String> {
    let odd = |c: char| matches!(c, ':' | '/') || c.is_whitespace() || c.is_control();
    (name.is_empty() || name.contains(odd))
        .then(|| format!("'{name}' is not a device name: one word without ':' and '/'"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    use crate::listen::LogFormat;
    use crate::server::Limits;
    use ztl_tests::garbage::Garbage;
    use ztl_yaml::Diagnostics;

    /// The endpoints of serial ports and TCP.
    fn endpoint(text: &str) -> Result<Endpoint, String> {
        text.parse()
            .map_err(|error: super::super::EndpointError| error.to_string())
    }

    fn parse(text: &str) -> Result<Config, Diagnostics> {
        let document = Document::parse("lab.yaml", text.as_bytes())?;
        match Config::read(&document, Path::new("/lab"), endpoint) {
            (Some(config), mistakes) if mistakes.is_empty() => Ok(config),
            (_, mistakes) => Err(Diagnostics::new(mistakes)),
        }
    }

    #[test]
    fn every_key_is_read() {
        let own_program = std::env::current_exe().expect("a file that is there");
        let text = format!(
            "scope: /lab\nport: 12345\nbind: '*'\nallow: [192.168.7.0/24, 10.1.2.3]\n\
             key: robot.key_secret\nclient-keys: /lab=anna.key\npublish: 12346\npublish-format: raw\njournal: state\nlog: debug\n\
             limits: {{running: 20, keep: 10min}}\n\
             log-format: json\ndevices:\n  gripper: serial:/dev/serial/by-id/usb-x?baud=9600\n  \
             head:\n    url: serial:/dev/ttyUSB0\n    baud: 57600\n    elf: {}\n  \
             arm: {{url: 'tcp:localhost:7000'}}\n",
            own_program.display()
        );
        let serial = |path: &str, baud| Endpoint::Serial {
            path: path.to_owned(),
            baud,
        };
        let arm = Endpoint::Tcp {
            address: "localhost:7000".to_owned(),
        };
        let mut head = DeviceConfig::new("head", serial("/dev/ttyUSB0", 57600));
        head.elf = Some(own_program);
        let mut limits = Limits::default();
        (limits.running, limits.keep) = (20, Duration::from_secs(600));
        let expected = Config {
            scope: Some("/lab".to_owned()),
            listen: Listen {
                publish: Some(12346),
                port: Some(12345),
                bind: Some("*".to_owned()),
                allow: vec![
                    "192.168.7.0/24".parse().unwrap(),
                    "10.1.2.3/32".parse().unwrap(),
                ],
                key: Some(PathBuf::from("/lab/robot.key_secret")),
                client_keys: vec!["/lab=/lab/anna.key".to_owned()],
                keyless: None,
                limits,
                log: Some(tracing::Level::DEBUG),
                log_format: Some(LogFormat::Json),
            },
            publish_format: Some(ReadingFormat::Raw),
            journal: Some(JournalPlace::At(PathBuf::from("/lab/state"))),
            devices: vec![
                DeviceConfig::new("gripper", serial("/dev/serial/by-id/usb-x", 9600)),
                head,
                DeviceConfig::new("arm", arm),
            ],
        };
        assert_eq!(parse(&text), Ok(expected));
        assert_eq!(parse(""), Ok(Config::default()));
        let off = parse("journal: off").expect("it is right");
        assert_eq!(off.journal, Some(JournalPlace::Off));
    }

    #[test]
    fn each_mistake_is_shown_with_its_place_and_what_is_expected() {
        let text = "\
prot: 12345
scope: a;b
bind: not an address
publish: many
log: loud
publish-format: xml
devices:
  gripper: usb:1
  head:
    url: tcp:localhost:7000
    baud: 9600
    efl: head.elf
  a/b: tcp:h:1
  wrist:
    baud: fast
  one: serial:/dev/ttyACM0
  two: serial:/dev/ttyACM0?baud=9600
  arm: {url: tcp:ho:2, elf: no/such.elf}
";
        let mistakes = parse(text).expect_err("mistakes").to_string();
        let first: Vec<&str> = mistakes
            .lines()
            .filter(|line| line.starts_with("lab.yaml:"))
            .collect();
        let expected = [
            "lab.yaml:1:1: unknown key 'prot'; did you mean 'port'?",
            "lab.yaml:2:8: the scope 'a;b' contains ';', so no client can reach it; write it as /lab",
            "lab.yaml:3:7: 'not an address' is not an address; use 127.0.0.1 for this machine only, or '*' for every interface",
            "lab.yaml:4:10: 'many' is not a port, a whole number from 0 to 65535",
            "lab.yaml:5:6: 'loud' is not known here; there are: error, warn, info, debug",
            "lab.yaml:6:17: 'xml' is not known here; there are: values, raw",
            "lab.yaml:8:12: unknown kind of device 'usb'; use serial:/dev/ttyACM0?baud=115200, tcp:HOST:PORT, or rs485:/dev/ttyUSB0?baud=115200 for a shared line",
            "lab.yaml:11:11: only a serial port has a line rate",
            "lab.yaml:12:5: unknown key 'efl'; did you mean 'elf'?",
            "lab.yaml:13:3: 'a/b' is not a device name: one word without ':' and '/'",
            "lab.yaml:15:5: 'url' is missing; write url: serial:/dev/ttyACM0",
            "lab.yaml:17:8: 'one' is at serial:/dev/ttyACM0 already",
            "lab.yaml:18:29: there is no file /lab/no/such.elf",
        ];
        assert_eq!(first, expected, "{mistakes}");
        let shown = "  8 |   gripper: usb:1\n    |            ^^^^^\n";
        assert!(mistakes.contains(shown), "{mistakes}");
    }

    #[test]
    fn values_of_the_wrong_type_are_reported() {
        for (text, part) in [
            (
                "- a",
                "lab.yaml:1:1: found a list; expected a mapping: scope, port, devices",
            ),
            ("port: [1]", "lab.yaml:1:7: found a list; expected a port"),
            ("port: -1", "'-1' is not a port"),
            ("devices: gripper", "lab.yaml:1:10: found a single value"),
            (
                "devices: {a: [x]}",
                "lab.yaml:1:14: found a list; expected where the device is",
            ),
            (
                "devices: {a: ~}",
                "lab.yaml:1:14: found nothing; expected where",
            ),
            (
                "devices: {a: {url: serial:/dev/x, baud: 0}}",
                "'0' is not a line rate",
            ),
            ("scope: $ztl", "belongs to the protocol itself"),
            (
                "allow: [10.0.0.0/8, lan]",
                "lab.yaml:1:21: 'lan' is not a network",
            ),
            // What protects the server is not left out by a forgotten value.
            ("key:", "lab.yaml:1:5: found nothing; expected the file"),
            ("allow:", "lab.yaml:1:7: found nothing; expected a network"),
            (
                "allow: []",
                "lab.yaml:1:8: the list is empty, which would allow every address; write a network",
            ),
            (
                "{key: robot.key_secret, client-keys: }",
                "found nothing; expected a client's key",
            ),
            ("sever-key: a", "lab.yaml:1:1: unknown key 'sever-key'"),
            ("[a]: 1", "lab.yaml:1:1: a key is a single word"),
        ] {
            let mistakes = parse(text).expect_err(text).to_string();
            assert!(mistakes.contains(part), "{text}: {mistakes}");
        }
    }

    #[test]
    fn no_file_causes_a_panic() {
        const WHOLE: &str = "scope: /lab\nport: 1\nbind: '*'\npublish: 2\npublish-format: raw\njournal: x\nlog: info\nlog-format: text\n\
            devices:\n  a: tcp:g:1\n  b: {url: serial:/dev/x?baud=9600, baud: 1, elf: y}\n  c:\n    url: tcp:h:1\n";
        let mut numbers = Garbage::new(0x2545_f491_4f6c_dd1d);
        for _ in 0..5_000 {
            let bytes = numbers.spoil(WHOLE);
            if let Ok(document) = Document::parse("f", &bytes) {
                let (_, mistakes) = Config::read(&document, Path::new(""), endpoint);
                let _ = Diagnostics::new(mistakes).to_string();
            }
        }
    }
}
