//! Keys for encrypted connections.

use ztl_std::RemoteTask;
use ztl_std::keys::KeyPair;

use super::{Process, Scratch, connect, ztl};

/// Pairs of keys made by `ztl keys`.
#[derive(Debug)]
pub struct Keys(Scratch);

impl Keys {
    /// A pair for each of these names.
    #[track_caller]
    pub fn make(names: &[&str]) -> Self {
        let keys = Self(Scratch::new());
        for name in names {
            let ended = Process::run(ztl().arg("keys").arg(keys.0.path(name)));
            assert_eq!(ended.code, Some(0), "{ended:?}");
        }
        keys
    }

    /// The path of a file, such as `anna.key_secret`.
    pub fn path(&self, file: &str) -> String {
        self.0.path(file).display().to_string()
    }

    /// The options of a client with the keys of `own`.
    pub fn options(&self, own: &str, server: &str) -> [String; 4] {
        let own = self.path(&format!("{own}.key_secret"));
        let server = self.path(&format!("{server}.key"));
        ["--key".into(), own, "--server-key".into(), server]
    }

    /// A pair as Rust takes it.
    #[track_caller]
    pub fn pair(&self, name: &str) -> KeyPair {
        KeyPair::read(&self.0.path(format!("{name}.key_secret"))).expect("keys")
    }

    /// A client with the keys of `own`, which waits patiently.
    #[track_caller]
    pub fn client(&self, endpoint: &str, own: &str, server: &str) -> RemoteTask {
        let remote = connect(endpoint);
        let server = self.pair(server).public();
        remote
            .with_keys(self.pair(own), server)
            .expect("encryption")
    }
}
