//! Whom to trust behind `https` and `wss`: the authorities of the system, or the certificates that the file pins.

use std::fmt;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::verify_server_name;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, RootCertStore, SignatureScheme,
};

/// The longest file with certificates, in bytes. All authorities of a system take a quarter of it.
const LONGEST_FILE: u64 = 1 << 20;

/// Which certificates of a host are right.
#[derive(Debug, Clone)]
pub(crate) enum Trust {
    /// Those that an authority of the system has signed.
    System,
    /// Those of a file, and those that they have signed.
    Pinned(Arc<ClientConfig>),
}

impl Trust {
    /// Reads the certificates of a PEM file.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn pinned(file: &Path) -> Result<Self, String> {
        let wrong = |why: &dyn fmt::Display| format!("{}: {why}", file.display());
        let text = ztl_std::files::read(file, LONGEST_FILE).map_err(|error| wrong(&error))?;
        let certificates = CertificateDer::pem_slice_iter(&text)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| wrong(&error))?;
        if certificates.is_empty() {
            return Err(wrong(&"no certificate: expected PEM"));
        }
        let mut roots = RootCertStore::empty();
        for certificate in &certificates {
            let added = roots.add(certificate.clone());
            added.map_err(|error| wrong(&format_args!("not a certificate: {error}")))?;
        }
        let chains = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider())
            .build()
            .map_err(|error| wrong(&error))?;
        let pins = Pins {
            certificates,
            chains,
        };
        let config = builder().map(|builder| {
            let dangerous = builder.dangerous();
            dangerous
                .with_custom_certificate_verifier(Arc::new(pins))
                .with_no_client_auth()
        })?;
        Ok(Self::Pinned(Arc::new(config)))
    }

    /// The authorities of the system. They are read now, since that takes time which a request may not have.
    pub(super) fn system() -> Self {
        // Without authorities, the request says so.
        let _ = Self::System.config();
        Self::System
    }

    /// How a connection begins.
    ///
    /// # Errors
    /// The system has no authorities.
    pub(super) fn config(&self) -> Result<Arc<ClientConfig>, String> {
        /// Read once, since there are more than a hundred.
        static SYSTEM: OnceLock<Result<Arc<ClientConfig>, String>> = OnceLock::new();
        match self {
            Self::Pinned(config) => Ok(Arc::clone(config)),
            Self::System => SYSTEM.get_or_init(system).clone(),
        }
    }

    /// Why a connection to this host cannot be trusted.
    pub(super) fn mistake(&self, host: &str, error: &Error) -> String {
        match error {
            Error::InvalidCertificate(error) => match error {
                CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
                    format!(
                        "the certificate of {host} has expired, or this machine's clock is wrong"
                    )
                }
                CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
                    format!(
                        "the certificate of {host} is not valid yet, or this machine's clock is wrong"
                    )
                }
                CertificateError::NotValidForName => {
                    format!("the certificate of {host} is for another name")
                }
                CertificateError::NotValidForNameContext { presented, .. } => {
                    let names = presented.join(", ");
                    format!("the certificate of {host} is for another name: {names}")
                }
                error if is_about_chain(error) => match self {
                    Self::System => format!(
                        "the certificate of {host} is from nobody whom this system trusts; pin it, as http: {{robot: {{host: {host}, certificate: robot.pem}}}}"
                    ),
                    Self::Pinned(_) => format!(
                        "the certificate of {host} is not the one of the file, nor signed by it"
                    ),
                },
                other => format!("the certificate of {host} cannot be used: {other}"),
            },
            Error::InvalidMessage(_) => format!("{host} does not speak TLS at this port: {error}"),
            other => format!("no encrypted connection to {host}: {other}"),
        }
    }
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

fn builder() -> Result<rustls::ConfigBuilder<ClientConfig, rustls::WantsVerifier>, String> {
    let builder = ClientConfig::builder_with_provider(provider());
    let builder = builder.with_safe_default_protocol_versions();
    builder.map_err(|error| error.to_string())
}

fn system() -> Result<Arc<ClientConfig>, String> {
    let found = rustls_native_certs::load_native_certs();
    let mut roots = RootCertStore::empty();
    roots.add_parsable_certificates(found.certs);
    if roots.is_empty() {
        let why = match found.errors.first() {
            Some(error) => format!(": {error}"),
            None => String::new(),
        };
        return Err(format!(
            "this system has no authorities for certificates{why}; install ca-certificates, or pin the robot's"
        ));
    }
    let config = builder()?;
    Ok(Arc::new(
        config.with_root_certificates(roots).with_no_client_auth(),
    ))
}

/// Accepts the certificates of a file, and those that they have signed.
#[derive(Debug)]
struct Pins {
    certificates: Vec<CertificateDer<'static>>,
    chains: Arc<WebPkiServerVerifier>,
}

impl ServerCertVerifier for Pins {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let chains = &self.chains;
        let verified =
            chains.verify_server_cert(end_entity, intermediates, server_name, ocsp_response, now);
        let is_pinned = self.certificates.iter().any(|pinned| pinned == end_entity);
        match verified {
            // A chain is checked from its end, dates first: these two only say that the certificate itself is no end of
            // a chain. Most self-signed ones are authorities, too.
            Err(Error::InvalidCertificate(error)) if is_pinned && is_about_chain(&error) => {
                let certificate = ParsedCertificate::try_from(end_entity)?;
                verify_server_name(&certificate, server_name)?;
                Ok(ServerCertVerified::assertion())
            }
            verified => verified,
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let chains = &self.chains;
        chains.verify_tls12_signature(message, certificate, signed)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let chains = &self.chains;
        chains.verify_tls13_signature(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.chains.supported_verify_schemes()
    }
}

/// Whether only the chain to an authority is missing.
fn is_about_chain(error: &CertificateError) -> bool {
    match error {
        CertificateError::UnknownIssuer => true,
        // rustls has no name of its own for it.
        CertificateError::Other(other) => {
            other.0.downcast_ref::<webpki::Error>() == Some(&webpki::Error::CaUsedAsEndEntity)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_never_ends_is_not_read() {
        let endless = Trust::pinned(Path::new("/dev/zero"));
        assert!(endless.is_err_and(|it| it == "/dev/zero: it is not a regular file"));
    }
}
