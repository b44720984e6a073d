//! Keys for images, and signed images.

use std::error::Error;
use std::fs::{self, OpenOptions};
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use ed25519_dalek::{Digest, Sha512, Signature, Signer, SigningKey, VerifyingKey};
use ztl_core::manifest::{HEAD_LEN, IMAGE_UNIT, Manifest, Parsed, Version};
use ztl_std::files;

use crate::connect_options::warn_if_exposed;
use crate::exit::{Done, Misuse};
use crate::terminal::line;

/// Longest file in bytes: more flash than a microcontroller has.
const MAX_FILE: u64 = 64 << 20;

/// A byte of erased flash.
const ERASED: u8 = 0xFF;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes NAME.firmware_key, the public key in 32 bytes, which goes into the firmware, and NAME.firmware_secret, the
secret key in hexadecimal digits, to keep private: who has it can replace the firmware of all devices with the public key."
)]
pub(crate) struct Keygen {
    /// Name of the key, or a path without extension
    #[arg(value_name = "NAME")]
    name: PathBuf,
}

impl Keygen {
    pub(crate) fn run(self) -> Done {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret)?;
        let key = SigningKey::from_bytes(&secret);
        let path = |extension: &str| {
            let mut path = self.name.as_os_str().to_owned();
            path.push(extension);
            PathBuf::from(path)
        };
        let (public, private) = (path(".firmware_key"), path(".firmware_secret"));
        create(&private, format!("{}\n", hex(&secret)).as_bytes(), 0o600)?;
        if let Err(error) = create(&public, key.verifying_key().as_bytes(), 0o644) {
            // Does not leave half a pair.
            let _ = fs::remove_file(&private);
            return Err(error);
        }
        line(format_args!(
            "{}: public key, for the firmware",
            public.display()
        ));
        line(format_args!(
            "{}: secret key, to keep private",
            private.display()
        ));
        Ok(ExitCode::SUCCESS)
    }
}

#[derive(Debug, clap::Args)]
pub(crate) struct Sign {
    /// The image as it is in the flash, such as `objcopy -O binary` makes it
    #[arg(value_name = "IMAGE")]
    image: PathBuf,
    /// The secret key: NAME.firmware_secret of `ztl firmware keygen`
    #[arg(short, long, value_name = "KEY")]
    key: PathBuf,
    /// The board for which the image is, as its firmware says: letters, digits, '-', '_' and '.'
    #[arg(long, value_name = "NAME")]
    board: String,
    /// Version of the image, as its firmware says: three numbers
    #[arg(long, value_name = "X.Y.Z")]
    version: Version,
}

impl Sign {
    pub(crate) fn run(self) -> Done {
        if io::stdout().is_terminal() {
            let message = "the signed image goes to stdout: add `> FILE`";
            return Err(Misuse::of(message).into());
        }
        let secret = read(&self.key)?;
        let secret = secret_key(&secret).ok_or_else(|| {
            format!(
                "{}: expected 64 hexadecimal digits, a NAME.firmware_secret of `ztl firmware keygen`",
                self.key.display()
            )
        })?;
        warn_if_exposed(&self.key);
        let mut image = read(&self.image)?;
        let path = self.image.display();
        if image.starts_with(b"\x7fELF") {
            let message =
                format!("{path}: an ELF file; expected what `objcopy -O binary` makes of it");
            return Err(message.into());
        }
        if Manifest::parse(&image).is_ok() {
            return Err(format!("{path}: the image is signed already").into());
        }
        image.resize(image.len().next_multiple_of(IMAGE_UNIT), ERASED);
        let manifest = Manifest {
            board: &self.board,
            version: self.version,
            length: u32::try_from(image.len())?,
        };
        let head = manifest
            .head()
            .map_err(|error| format!("{path}: {error}"))?;
        let signature = SigningKey::from_bytes(&secret).sign(&digest(&image, &head));
        let mut stdout = io::stdout().lock();
        let signature = signature.to_bytes();
        let mut parts = [head.as_slice(), &signature, &image].into_iter();
        let written = parts.try_for_each(|part| stdout.write_all(part));
        let written = written.and_then(|()| stdout.flush());
        written.map_err(|error| format!("cannot write the output: {error}"))?;
        Ok(ExitCode::SUCCESS)
    }
}

#[derive(Debug, clap::Args)]
pub(crate) struct Show {
    /// A file of `ztl firmware sign`
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The public key to verify it with: NAME.firmware_key of `ztl firmware keygen`
    #[arg(short, long, value_name = "KEY")]
    key: Option<PathBuf>,
}

impl Show {
    pub(crate) fn run(self) -> Done {
        let file = read(&self.file)?;
        let path = self.file.display();
        let parsed = parse(&self.file, &file)?;
        let Manifest {
            board,
            version,
            length,
        } = parsed.manifest;
        line(format_args!("board    {board}"));
        line(format_args!("version  {version}"));
        line(format_args!("image    {length} bytes"));
        let Some(key) = &self.key else {
            return Ok(ExitCode::SUCCESS);
        };
        if !read_key(key)?(&parsed) {
            let message = format!(
                "{path}: the signature is not one of {} over this image: it was signed with another key, or changed since",
                key.display()
            );
            return Err(message.into());
        }
        line("signed   with this key");
        Ok(ExitCode::SUCCESS)
    }
}

/// Parses a whole file of `ztl firmware sign`.
pub(super) fn parse<'f>(path: &Path, file: &'f [u8]) -> Result<Parsed<'f>, String> {
    let path = path.display();
    let parsed = Manifest::parse(file).map_err(|error| format!("{path}: {error}"))?;
    let (length, found) = (parsed.manifest.length, parsed.image.len());
    match usize::try_from(length) == Ok(found) {
        true => Ok(parsed),
        false => Err(format!(
            "{path}: the manifest says {length} bytes of image, but {found} follow it; is the file complete?"
        )),
    }
}

/// Reads a public key. Returns a function that verifies signatures with it.
pub(crate) fn read_key(
    path: &Path,
) -> Result<impl Fn(&Parsed<'_>) -> bool + use<>, Box<dyn Error>> {
    let bytes = <[u8; 32]>::try_from(read(path)?).ok();
    let public = bytes.and_then(|bytes| VerifyingKey::from_bytes(&bytes).ok());
    let public = public.ok_or_else(|| {
        format!(
            "{}: expected a key of 32 bytes, a NAME.firmware_key of `ztl firmware keygen`",
            path.display()
        )
    })?;
    Ok(move |parsed: &Parsed<'_>| {
        let signature = Signature::from_bytes(parsed.signature);
        let signed = digest(parsed.image, parsed.head);
        public.verify_strict(&signed, &signature).is_ok()
    })
}

/// What is signed, as `embassy-boot` verifies it in its partition: the image, and the manifest's head behind it.
fn digest(image: &[u8], head: &[u8; HEAD_LEN]) -> [u8; 64] {
    Sha512::new()
        .chain_update(image)
        .chain_update(head)
        .finalize()
        .into()
}

pub(super) fn read(path: &Path) -> Result<Vec<u8>, Box<dyn Error>> {
    let read = files::read(path, MAX_FILE);
    Ok(read.map_err(|error| format!("{}: {error}", path.display()))?)
}

/// Creates a file, and never overwrites one.
fn create(path: &Path, content: &[u8], mode: u32) -> Result<(), Box<dyn Error>> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, mode);
    #[cfg(not(unix))]
    let _ = mode;
    let failed = |error: io::Error| match error.kind() {
        io::ErrorKind::AlreadyExists => format!(
            "{} is there already, and a key is not overwritten; choose another name",
            path.display()
        ),
        _ => format!("{}: {error}", path.display()),
    };
    options
        .open(path)
        .and_then(|mut file| file.write_all(content))
        .map_err(failed)?;
    Ok(())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn secret_key(text: &[u8]) -> Option<[u8; 32]> {
    let text = text.trim_ascii();
    let mut key = [0; 32];
    if text.len() != 2 * key.len() {
        return None;
    }
    for (byte, digits) in key.iter_mut().zip(text.chunks(2)) {
        let digits = str::from_utf8(digits).ok()?;
        // `from_str_radix` takes a sign.
        if !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
            return None;
        }
        *byte = u8::from_str_radix(digits, 16).ok()?;
    }
    Some(key)
}
