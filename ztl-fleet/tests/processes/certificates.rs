//! Certificates that `--check` reads, that are out of date, or that another part does not accept.

use std::io::Write as _;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use ztl_std::keys::KeyPair;
use ztl_tests::lab::{Ended, PATIENCE, Process, Scratch, reserve_port, until};

use crate::fleet;

/// An authority in a directory of its own.
struct Authority(Scratch);

impl Authority {
    fn new() -> Self {
        let scratch = Scratch::new();
        let script = "../examples/fleet/universities/certificate.sh";
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(script);
        std::fs::copy(script, scratch.path("certificate.sh")).unwrap();
        Self(scratch)
    }

    fn run(&self, words: &[&str]) -> String {
        let mut command = Command::new(words[0]);
        let ended = command
            .args(&words[1..])
            .current_dir(self.0.path("."))
            .output()
            .unwrap();
        assert!(ended.status.success(), "{words:?}: {ended:?}");
        String::from_utf8(ended.stdout).unwrap()
    }

    /// Makes a certificate for this machine.
    fn make(&self, name: &str) -> &Self {
        self.run(&["sh", "certificate.sh", name, "127.0.0.1"]);
        self
    }

    /// Makes one that is valid from and to these times.
    fn make_dated(&self, name: &str, from: &str, to: &str) {
        let config = "[ca]\ndefault_ca = ca\n[ca]\ndatabase = index.txt\nserial = serial\nnew_certs_dir = .\n\
            default_md = sha256\npolicy = any\nx509_extensions = part\nunique_subject = no\n[any]\ncommonName = supplied\n\
            [part]\nsubjectAltName = IP:127.0.0.1\nbasicConstraints = critical,CA:FALSE\n\
            extendedKeyUsage = serverAuth,clientAuth\n";
        self.write("ca.cnf", config);
        self.write("index.txt", "");
        self.write("serial", "1000\n");
        self.make(name);
        let (key, subject) = (format!("{name}.key.pem"), format!("/CN={name}"));
        let request = ["openssl", "req", "-new", "-key", &key, "-subj", &subject];
        self.run(&[&request[..], &["-out", "request.pem"]].concat());
        let signed = ["openssl", "ca", "-batch", "-notext", "-config", "ca.cnf"];
        let by = ["-cert", "ca.pem", "-keyfile", "ca.key.pem"];
        let dates = ["-startdate", from, "-enddate", to];
        let files = ["-in", "request.pem", "-out", &format!("{name}.pem")];
        self.run(&[&signed[..], &by, &dates, &files].concat());
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let file = self.0.path(name);
        std::fs::write(&file, text).unwrap();
        file
    }

    /// The file of what connects to a router, with a certificate of this name.
    fn endpoint(&self, router: &str, name: &str) -> PathBuf {
        let tls = format!("tls: {{ca: ca.pem, certificate: {name}.pem, key: {name}.key.pem}}");
        let text = format!("port: 0\nrouters: {router}\n{tls}\n");
        self.write(&format!("{name}.yaml"), &text)
    }

    /// Starts a router with a certificate of this name. Returns its address, too.
    fn router(&self, name: &str) -> (Process, String) {
        let address = format!("tls/127.0.0.1:{}", reserve_port());
        let tls = format!("tls: {{ca: ca.pem, certificate: {name}.pem, key: {name}.key.pem}}");
        let text = format!("listen: {address}\n{tls}\n");
        let file = self.write(&format!("{name}-router.yaml"), &text);
        let router = Process::start(&mut fleet(&["router"], &file));
        router.wait_for("Routing at");
        (router, address)
    }
}

/// Looks at a fleet until it says why the router is not reached: it looks for that for 1 s only, each time. Returns its log.
#[track_caller]
fn look(file: &Path, why: &str) -> String {
    until(why, PATIENCE, || {
        let ended = Process::run(&mut fleet(&["ls"], file));
        assert_eq!(ended.code, Some(1), "{ended:?}");
        ended.stderr.contains(why).then_some(ended.stderr)
    })
}

fn check(file: &Path) -> Ended {
    Process::run(fleet(&["endpoint", "--check"], file).env("LANG", "C"))
}

#[test]
fn a_private_key_that_others_can_read_causes_a_warning() {
    use std::os::unix::fs::PermissionsExt;

    let own = Authority::new();
    own.make("arm");
    let file = own.endpoint("tls/10.0.0.1:7447", "arm");
    let key = own.0.path("arm.key.pem");
    let said = format!(
        "{}: others can use this secret key (mode 644)",
        key.display()
    );
    for (mode, warned) in [(0o600, false), (0o644, true)] {
        std::fs::set_permissions(&key, std::fs::Permissions::from_mode(mode)).unwrap();
        let ended = check(&file);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert_eq!(ended.stderr.contains(&said), warned, "{ended:?}");
    }
}

#[test]
fn check_reads_certificates_and_tells_each_mistake_at_its_place() {
    let own = Authority::new();
    own.make("arm").make("leg");
    own.make_dated("old", "20200101000000Z", "20210101000000Z");
    own.make_dated("new", "21000101000000Z", "21010101000000Z");
    let pair = KeyPair::generate();
    pair.write(&own.0.path("arm")).unwrap();
    own.write("note.txt", "nothing\n");
    let other = Authority::new();
    let foreign = other.make("arm").0.path("ca.pem");
    std::fs::copy(foreign, own.0.path("foreign.pem")).unwrap();
    let checked = |ca: &str, certificate: &str, key: &str| {
        let tls = format!("ca: {ca}\n  certificate: {certificate}\n  key: {key}\n");
        let text = format!("port: 0\nrouters: tls/10.0.0.1:7447\ntls:\n  {tls}");
        check(&own.write("endpoint.yaml", &text))
    };
    let good = checked("ca.pem", "arm.pem", "arm.key.pem");
    assert_eq!(good.code, Some(0), "{good:?}");
    for (files, told) in [
        (["no.pem", "arm.pem", "arm.key.pem"], "4:7: cannot read"),
        (["ca.pem", "no.pem", "arm.key.pem"], "5:16: cannot read"),
        (["ca.pem", "arm.pem", "no.pem"], "6:8: cannot read"),
        (
            ["note.txt", "arm.pem", "arm.key.pem"],
            "note.txt' is not in PEM; expected a certificate",
        ),
        (
            ["ca.pem", "arm.key.pem", "arm.key.pem"],
            "arm.key.pem' has a private key; expected a certificate",
        ),
        (
            ["ca.pem", "arm.pem", "arm.pem"],
            "arm.pem' has a certificate; expected the certificate's private key",
        ),
        (
            ["ca.pem", "arm.pem", "arm.key"],
            "arm.key' has a key of `ztl keys`, which is for 'fleet-key'",
        ),
        (
            ["ca.pem", "arm.pem", "leg.key.pem"],
            "6:8: this key does not belong to the certificate",
        ),
        (
            ["foreign.pem", "arm.pem", "arm.key.pem"],
            "5:16: the certificate is not signed by an authority in 'ca'",
        ),
        (
            ["ca.pem", "old.pem", "old.key.pem"],
            "5:16: the certificate expired at 2021-01-01T00:00:00Z",
        ),
        (
            ["ca.pem", "new.pem", "new.key.pem"],
            "5:16: the certificate is not valid before 2100-01-01T00:00:00Z",
        ),
        // A wrong date does not hide what never fits.
        (
            ["foreign.pem", "old.pem", "old.key.pem"],
            "5:16: the certificate is not signed by an authority in 'ca'",
        ),
    ] {
        let [ca, certificate, key] = files;
        let ended = checked(ca, certificate, key);
        assert_eq!(ended.code, Some(2), "{files:?} {ended:?}");
        assert!(ended.stderr.contains(told), "{told}: {ended:?}");
    }
}

#[test]
fn a_certificate_that_is_out_of_date_is_told_where_it_keeps_parts_from_connecting() {
    let own = Authority::new();
    own.make("arm");
    own.make_dated("old", "20200101000000Z", "20210101000000Z");
    let expired =
        "the certificate expired at 2021-01-01T00:00:00Z, and the clock of this machine says 2";
    // The clock may be wrong.
    let (old, old_address) = own.router("old");
    old.wait_for(expired);
    let (_good, address) = own.router("arm");
    let unaccepted = format!(
        "{address}: the router does not accept the certificate of this machine (CertificateExpired); renew it, or set the clock"
    );
    let told = look(&own.endpoint(&address, "old"), &unaccepted);
    assert!(told.contains(expired), "{told}");
    let wrong = format!("{old_address}: about the router: {expired}");
    look(&own.endpoint(&old_address, "arm"), &wrong);
    // All is well, and no robot is there.
    let ended = Process::run(&mut fleet(&["ls"], &own.endpoint(&address, "arm")));
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn certificates_of_two_authorities_are_told_at_both_ends() {
    let [own, other] = [Authority::new(), Authority::new()];
    own.make("arm");
    other.make("arm");
    let (_router, address) = own.router("arm");
    let told = format!(
        "{address}: about the router: the certificate is not signed by an authority in 'ca'"
    );
    look(&other.endpoint(&address, "arm"), &told);
}

#[test]
fn who_sends_a_byte_now_and_then_does_not_hold_up_a_command() {
    let own = Authority::new();
    own.make("arm");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tls/{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for mut near in listener.incoming().flatten() {
            std::thread::spawn(move || {
                // The beginning of a record of 16 KiB.
                let mut sent = near.write_all(&[22, 3, 3, 64, 0]);
                while sent.is_ok() {
                    // The time is the fault.
                    std::thread::sleep(Duration::from_millis(100));
                    sent = near.write_all(&[2]);
                }
            });
        }
    });
    let ls = Process::start(&mut fleet(&["ls"], &own.endpoint(&address, "arm")));
    let ended = ls.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let told = format!("{address}: something listens there, but it does not answer as a router");
    assert!(ended.stderr.contains(&told), "{ended:?}");
}

#[test]
fn the_authority_of_the_example_is_valid_for_ten_years() {
    let own = Authority::new();
    own.make("arm");
    let in_years = |file: &str, years: u32| {
        let seconds = (years * 365 * 24 * 3600).to_string();
        let mut asked = Command::new("openssl");
        asked.args(["x509", "-noout", "-checkend", &seconds, "-in", file]);
        asked
            .current_dir(own.0.path("."))
            .output()
            .unwrap()
            .status
            .success()
    };
    assert!(in_years("ca.pem", 9) && !in_years("ca.pem", 11));
    assert!(!in_years("arm.pem", 2));
}

#[test]
fn strangers_that_do_not_speak_tls_do_not_keep_others_out() {
    /// Zenoh would wait 0.1 s after each.
    const STRANGERS: usize = 300;

    let own = Authority::new();
    own.make("arm");
    let (_router, address) = own.router("arm");
    let place = address.strip_prefix("tls/").unwrap();
    let strangers: Vec<TcpStream> = (0..STRANGERS)
        .map(|_| {
            let mut stranger = TcpStream::connect(place).unwrap();
            stranger.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
            stranger
        })
        .collect();
    let ended = Process::run(&mut fleet(&["ls"], &own.endpoint(&address, "arm")));
    let help = "was zenoh-link-tls built before .cargo/config.toml changed? run: cargo clean -p zenoh-link-tls, and build again";
    assert_eq!(ended.code, Some(0), "{help}: {ended:?}");
    drop(strangers);
}
