//! Where recorded messages come from.

/// A publisher, or the program that writes the recording.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Source {
    /// Its name in the recorder's configuration file, or its address.
    pub name: String,
    /// Its address, such as `tcp://robot:6000`; empty if it has none.
    pub endpoint: String,
    /// Its public key, if it has proved that it has the secret key; otherwise empty.
    pub key: String,
}

impl Source {
    /// One with a name only.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            ..Self::default()
        }
    }

    /// Its entries in the metadata of its channels.
    pub(crate) fn metadata(&self) -> impl Iterator<Item = (&'static str, &str)> {
        let all = [
            ("publisher", self.name.as_str()),
            ("endpoint", &self.endpoint),
            ("key", &self.key),
        ];
        all.into_iter().filter(|(_, value)| !value.is_empty())
    }
}
