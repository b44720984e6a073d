//! Certificates, and servers that show them.

use std::process::Command;
use std::sync::Arc;

use rustls::ServerConfig;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use ztl_tests::lab::Scratch;

use super::web::{Request, Web, Wire};

/// Runs `openssl` in a directory.
#[track_caller]
fn openssl(files: &Scratch, words: &str) {
    let mut openssl = Command::new("openssl");
    let made = openssl
        .current_dir(files.path(""))
        .args(words.split(' '))
        .output()
        .expect("openssl, of the Debian package of that name");
    assert!(made.status.success(), "{made:?}");
}

const KEY: &str = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";

/// A self-signed certificate `NAME.pem` for these names, and its key.
#[track_caller]
pub(crate) fn self_signed(files: &Scratch, name: &str, names: &str) {
    openssl(
        files,
        &format!(
            "req -x509 {KEY} -days 2 -subj /CN=robot -addext subjectAltName={names} -keyout {name}.key -out {name}.pem"
        ),
    );
}

/// A certificate `NAME.pem` that `by` has signed for this machine, between these dates, and its key.
#[track_caller]
pub(crate) fn signed(files: &Scratch, name: &str, by: &str, dates: [&str; 2]) {
    std::fs::write(
        files.path("ca.cnf"),
        "[ca]\ndefault_ca=d\n[d]\ndatabase=index.txt\nnew_certs_dir=.\nrand_serial=yes\ndefault_md=sha256\npolicy=p\nunique_subject=no\nx509_extensions=x\n[p]\ncommonName=supplied\n[x]\nsubjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n",
    )
    .expect("to write");
    std::fs::write(files.path("index.txt"), "").expect("to write");
    openssl(
        files,
        &format!("req -new {KEY} -subj /CN={name} -keyout {name}.key -out {name}.csr"),
    );
    let [start, end] = dates;
    openssl(
        files,
        &format!(
            "ca -config ca.cnf -batch -notext -keyfile {by}.key -cert {by}.pem -startdate {start} -enddate {end} -in {name}.csr -out {name}.pem"
        ),
    );
}

/// A server with this certificate.
pub(crate) fn server(
    files: &Scratch,
    name: &str,
    answer: impl Fn(&Request, &mut Wire) + Send + Sync + 'static,
) -> Web {
    let chain = CertificateDer::pem_file_iter(files.path(format!("{name}.pem")));
    let chain = chain.and_then(Iterator::collect).expect("a certificate");
    let key = PrivateKeyDer::from_pem_file(files.path(format!("{name}.key"))).expect("a key");
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .and_then(|builder| builder.with_no_client_auth().with_single_cert(chain, key))
        .expect("a configuration");
    Web::with(Some(Arc::new(config)), answer)
}
