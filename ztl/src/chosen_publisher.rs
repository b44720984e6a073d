//! Which publisher to subscribe to: one of the configuration file, or an address.

use std::path::Path;
use std::time::{Duration, Instant};

use ztl_std::keys::PublicKey;
use ztl_std::remotes::{Remote, usual_path};
use ztl_std::{Remotes, Subscriber};

use crate::connect_options::KeyOptions;
use crate::exit::Misuse;

/// A publisher.
pub(crate) struct ChosenPublisher {
    /// As it was given.
    name: String,
    endpoint: String,
    /// Its entry in the configuration file.
    remote: Option<Remote>,
}

/// A publisher that is subscribed to.
#[cfg_attr(
    not(feature = "record"),
    expect(dead_code, reason = "this build has no recordings")
)]
pub(crate) struct Connected {
    /// As it was given.
    pub(crate) name: String,
    pub(crate) endpoint: String,
    /// The key that it has to prove.
    pub(crate) key: Option<PublicKey>,
    pub(crate) subscriber: Subscriber,
}

/// After this time without a connection it is said.
const SOON: Duration = Duration::from_secs(2);

/// Notices whether a publisher is there.
pub(crate) struct Presence {
    since: Instant,
    is_connected: bool,
    /// Whether its absence was noticed.
    is_missed: bool,
}

/// What [`Presence`] has noticed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Noticed {
    Connected,
    /// The connection was lost.
    Lost,
    /// For some time there has been no connection, from the start.
    Absent,
}

impl Presence {
    pub(crate) fn new() -> Self {
        Self {
            since: Instant::now(),
            is_connected: false,
            is_missed: false,
        }
    }

    /// Returns what is new.
    pub(crate) fn notice(&mut self, is_connected: bool) -> Option<Noticed> {
        let noticed = match (self.is_connected, is_connected) {
            (false, true) => Noticed::Connected,
            (true, false) => Noticed::Lost,
            (false, false) if !self.is_missed && self.since.elapsed() >= SOON => Noticed::Absent,
            _ => return None,
        };
        self.is_connected = is_connected;
        self.is_missed = !is_connected;
        Some(noticed)
    }
}

impl ChosenPublisher {
    /// A publisher of a configuration file.
    #[cfg(any(feature = "record", feature = "web"))]
    pub(crate) fn named(name: &str, remote: Remote) -> Self {
        Self {
            name: name.to_owned(),
            endpoint: remote.endpoint(),
            remote: Some(remote),
        }
    }

    /// Finds a publisher by its name in the configuration file, or by its address.
    pub(crate) fn find(text: &str, config: Option<&Path>) -> Result<Self, Misuse> {
        let (endpoint, remote) = match text.contains("://") {
            true => (text.to_owned(), None),
            false => {
                let remote = named(text, config)?;
                (remote.endpoint(), Some(remote))
            }
        };
        Ok(Self {
            name: text.to_owned(),
            endpoint,
            remote,
        })
    }

    /// Subscribes to these scopes, or to the publisher's scope in the configuration file, or to all.
    pub(crate) fn connect(
        self,
        scopes: &[String],
        keys: &KeyOptions,
    ) -> Result<Connected, Box<dyn std::error::Error>> {
        let mut builder = Subscriber::builder();
        if scopes.is_empty()
            && let Some(remote) = &self.remote
        {
            builder = builder.scope(&remote.scope);
        }
        for scope in scopes {
            builder = builder.scope(scope);
        }
        let keys = keys.read(self.remote.and_then(|remote| remote.keys).as_ref())?;
        let mut key = None;
        if let Some((own, publisher)) = keys {
            key = Some(publisher);
            builder = builder.keys(own, publisher);
        }
        let subscriber = builder.connect(&self.endpoint);
        Ok(Connected {
            name: self.name,
            endpoint: self.endpoint,
            key,
            subscriber: subscriber.map_err(|error| Misuse(error.to_string()))?,
        })
    }
}

/// The configuration file.
pub(crate) fn configuration(config: Option<&Path>) -> Result<Remotes, Misuse> {
    let path = config.map_or_else(usual_path, Path::to_owned);
    Remotes::load(&path).map_err(|mistakes| Misuse(mistakes.to_string()))
}

/// A publisher of the configuration file.
fn named(name: &str, config: Option<&Path>) -> Result<Remote, Misuse> {
    let path = usual_path();
    if config.is_none() && !path.exists() {
        let path = path.display();
        let mistake = format!("no {path} to look up '{name}'; an address begins with tcp://");
        return Err(Misuse(mistake));
    }
    let found = configuration(config)?.publisher(name).cloned();
    found.map_err(|error| Misuse(format!("{error} (an address begins with tcp://)")))
}
