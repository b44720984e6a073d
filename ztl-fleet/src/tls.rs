//! Certificates in PEM, read before Zenoh uses them, so that each mistake has its place; and why a connection over TLS fails.

use std::io::{self, ErrorKind};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, UNIX_EPOCH};

use rustls::client::verify_server_cert_signed_by_trust_anchor;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::{ParsedCertificate, WebPkiClientVerifier};
use rustls::sign::CertifiedKey;
use rustls::version::TLS13;
use rustls::{AlertDescription, CertificateError, ClientConfig, ClientConnection, RootCertStore};
use ztl_std::files;
use ztl_std::time::rfc3339;

/// Longest file in bytes.
const LONGEST: u64 = 1 << 20;

/// How long a handshake may take that only looks.
const LONGEST_TALK: Duration = Duration::from_secs(2);

/// Certificates for connections over TLS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tls {
    /// Certificates of the authorities whose peers are accepted, in PEM.
    pub ca: PathBuf,
    /// The own certificate, in PEM.
    pub certificate: PathBuf,
    /// Its private key, in PEM.
    pub key: PathBuf,
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    files::read(path, LONGEST).map_err(|error| format!("cannot read '{}': {error}", path.display()))
}

/// Whether a file has this text.
fn has(bytes: &[u8], text: &str) -> bool {
    bytes
        .windows(text.len())
        .any(|part| part == text.as_bytes())
}

/// What a file that was taken for another one is.
fn found(bytes: &[u8]) -> &'static str {
    match bytes {
        bytes if has(bytes, "-----BEGIN ENCRYPTED PRIVATE KEY") => {
            "has a private key with a password, which Zenoh cannot use"
        }
        bytes if has(bytes, "PRIVATE KEY-----") => "has a private key",
        bytes if has(bytes, "-----BEGIN CERTIFICATE-----") => "has a certificate",
        bytes if has(bytes, "public-key") => "has a key of `ztl keys`, which is for 'fleet-key'",
        _ => "is not in PEM",
    }
}

/// The certificates in a file.
pub(crate) fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let (bytes, name) = (read(path)?, path.display());
    let all: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    let all = all.map_err(|error| format!("'{name}' is not in PEM: {error}"))?;
    match all.is_empty() {
        true => Err(format!(
            "'{name}' {}; expected a certificate in PEM, as certificate.sh writes it: NAME.pem",
            found(&bytes)
        )),
        false => Ok(all),
    }
}

/// The authorities in a file.
pub(crate) fn authorities(path: &Path) -> Result<Arc<RootCertStore>, String> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(path)? {
        let added = roots.add(certificate);
        added.map_err(|error| format!("'{}': {}", path.display(), of(&error)))?;
    }
    Ok(Arc::new(roots))
}

/// The private key in a file.
pub(crate) fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, String> {
    let bytes = read(path)?;
    PrivateKeyDer::from_pem_slice(&bytes).map_err(|_| {
        format!(
            "'{}' {}; expected the certificate's private key in PEM, as certificate.sh writes it: NAME.key.pem",
            path.display(),
            found(&bytes)
        )
    })
}

/// Whether a key belongs to a certificate.
///
/// # Errors
/// That it does not.
pub(crate) fn belongs(
    key: &PrivateKeyDer<'static>,
    chain: &[CertificateDer<'static>],
) -> Result<(), String> {
    let both = CertifiedKey::from_der(chain.to_vec(), key.clone_key(), &provider());
    both.map(drop).map_err(|error| match error {
        rustls::Error::InconsistentKeys(_) => "this key does not belong to the certificate; \
             certificate.sh writes them together: NAME.pem and NAME.key.pem"
            .to_owned(),
        error => of(&error),
    })
}

/// For what a certificate is used.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Usage {
    /// Its owner connects.
    pub(crate) connects: bool,
    /// Others connect to its owner.
    pub(crate) listens: bool,
}

/// Whether others with the same authorities accept a certificate. Returns what is wrong with its dates, by this machine's clock.
///
/// # Errors
/// Why they never accept it.
pub(crate) fn check(
    chain: &[CertificateDer<'static>],
    roots: &Arc<RootCertStore>,
    usage: Usage,
) -> Result<Option<String>, String> {
    use CertificateError::{ExpiredContext, NotValidYetContext};

    let error = match accepted(chain, roots, usage, now()) {
        Ok(()) => return Ok(None),
        Err(error) => error,
    };
    let valid = match &error {
        rustls::Error::InvalidCertificate(ExpiredContext { not_after, .. }) => *not_after,
        rustls::Error::InvalidCertificate(NotValidYetContext { not_before, .. }) => *not_before,
        _ => return Err(of(&error)),
    };
    // The rest is judged as if the clock were right.
    accepted(chain, roots, usage, valid).map_err(|error| of(&error))?;
    Ok(Some(of(&error)))
}

fn accepted(
    chain: &[CertificateDer<'static>],
    roots: &Arc<RootCertStore>,
    usage: Usage,
    now: UnixTime,
) -> Result<(), rustls::Error> {
    let Some((own, rest)) = chain.split_first() else {
        return Err(rustls::Error::NoCertificatesPresented);
    };
    if usage.connects {
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::clone(roots), provider());
        let verifier = verifier.build();
        let verifier = verifier.map_err(|error| rustls::Error::General(error.to_string()))?;
        verifier.verify_client_cert(own, rest, now)?;
    }
    if usage.listens {
        let algorithms = provider().signature_verification_algorithms.all;
        let own = ParsedCertificate::try_from(own)?;
        verify_server_cert_signed_by_trust_anchor(&own, roots, rest, now, algorithms)?;
    }
    Ok(())
}

/// What is wrong, in the words of a file's reader.
fn of(error: &rustls::Error) -> String {
    use CertificateError::{BadSignature, ExpiredContext, NotValidYetContext, UnknownIssuer};

    let advice = "renew the certificate, or set the clock";
    match error {
        rustls::Error::InvalidCertificate(ExpiredContext { time, not_after }) => format!(
            "the certificate expired at {}, and the clock of this machine says {}; {advice}",
            date(*not_after),
            date(*time)
        ),
        rustls::Error::InvalidCertificate(NotValidYetContext { time, not_before }) => format!(
            "the certificate is not valid before {}, and the clock of this machine says {}; {advice}",
            date(*not_before),
            date(*time)
        ),
        // The latter has an authority of the same name.
        rustls::Error::InvalidCertificate(UnknownIssuer | BadSignature) => {
            "the certificate is not signed by an authority in 'ca'; all parts of a fleet have one"
                .to_owned()
        }
        error => error.to_string(),
    }
}

fn now() -> UnixTime {
    // A clock before 1970 is wrong anyway.
    UnixTime::since_unix_epoch(UNIX_EPOCH.elapsed().unwrap_or_default())
}

/// A time in RFC 3339.
fn date(at: UnixTime) -> String {
    let at = UNIX_EPOCH.checked_add(Duration::from_secs(at.as_secs()));
    let text = at.and_then(|at| rfc3339::serialize(&at, serde_json::value::Serializer).ok());
    let text = text.as_ref().and_then(serde_json::Value::as_str);
    let seconds = text.and_then(|text| text.split_once('.'));
    seconds.map_or_else(|| "another age".to_owned(), |(text, _)| format!("{text}Z"))
}

/// Why a router at the other end of a connection does not accept this machine, or is not accepted; `None` if TLS works.
pub(crate) fn obstacle(tls: &Tls, host: &str, mut stream: TcpStream) -> Option<String> {
    let mut connection = match client(tls, host) {
        Ok(connection) => connection,
        Err(why) => return Some(why),
    };
    let error = talk(&mut connection, &mut stream).err()?;
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref());
    match inner {
        Some(rustls::Error::AlertReceived(alert)) => {
            let advice = match alert {
                AlertDescription::CertificateExpired => {
                    "renew it, or set the clock here or at the router"
                }
                _ => "compare 'ca' at both ends, and the clocks",
            };
            Some(format!(
                "the router does not accept the certificate of this machine ({alert:?}); {advice}"
            ))
        }
        Some(error) => Some(format!("about the router: {}", of(error))),
        None if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => None,
        None => Some(format!(
            "the connection over TLS ends: {error}; is it a router with tls/… there?"
        )),
    }
}

/// Shakes hands, and then listens once: whether the own certificate is accepted is told after the handshake.
fn talk(connection: &mut ClientConnection, stream: &mut TcpStream) -> io::Result<()> {
    let end = Instant::now() + LONGEST_TALK;
    loop {
        while connection.wants_write() {
            connection.write_tls(stream)?;
        }
        let is_last = !connection.is_handshaking();
        if connection.read_tls(stream)? == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        let read = connection.process_new_packets();
        read.map_err(|error| io::Error::new(ErrorKind::InvalidData, error))?;
        if is_last {
            return Ok(());
        }
        // Somebody may send a byte now and then.
        if Instant::now() >= end {
            return Err(ErrorKind::TimedOut.into());
        }
    }
}

fn client(tls: &Tls, host: &str) -> Result<ClientConnection, String> {
    let (roots, chain) = (authorities(&tls.ca)?, certificates(&tls.certificate)?);
    let key = private_key(&tls.key)?;
    let name = ServerName::try_from(host.to_owned()).map_err(|error| error.to_string())?;
    let config = ClientConfig::builder_with_provider(provider());
    let config = config.with_protocol_versions(&[&TLS13]);
    let config = config.and_then(|config| {
        let config = config.with_root_certificates(roots);
        config.with_client_auth_cert(chain, key)
    });
    let connection = config.and_then(|config| ClientConnection::new(Arc::new(config), name));
    connection.map_err(|error| of(&error))
}
