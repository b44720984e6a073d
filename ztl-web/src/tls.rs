//! The console's certificate and key, for `https`.

use std::path::Path;
use std::sync::Arc;

use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject as _};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{Error, ServerConfig};
use ztl_std::files;

/// Most bytes of a file with certificates or a key.
const LONGEST: u64 = 1 << 20;

/// A certificate and its key.
#[derive(Clone)]
pub struct Tls(pub(crate) TlsAcceptor);

impl Tls {
    /// Reads PEM files: the certificate, with those of its issuers after it, and its key.
    ///
    /// # Errors
    /// What is wrong with which file.
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, String> {
        let wrong = |file: &Path, why: &dyn std::fmt::Display| format!("{}: {why}", file.display());
        let read = |file: &Path| files::read(file, LONGEST).map_err(|error| wrong(file, &error));
        let chain = CertificateDer::pem_slice_iter(&read(certificate)?)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| wrong(certificate, &error))?;
        if chain.is_empty() {
            return Err(wrong(certificate, &"no certificate: expected PEM"));
        }
        let secret = PrivateKeyDer::from_pem_slice(&read(key)?).map_err(|error| match error {
            pem::Error::NoItemsFound => wrong(key, &"no private key: expected PEM"),
            error => wrong(key, &error),
        })?;
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .and_then(|builder| {
                builder
                    .with_no_client_auth()
                    .with_single_cert(chain, secret)
            })
            .map_err(|error| match error {
                Error::InconsistentKeys(_) => wrong(
                    key,
                    &format_args!("not the key of {}", certificate.display()),
                ),
                error => wrong(certificate, &error),
            })?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self(TlsAcceptor::from(Arc::new(config))))
    }
}
