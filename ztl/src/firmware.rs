//! `ztl firmware`: images of firmware that devices take over their link (`docs/update.md`).

mod sign;

use crate::exit::Done;

#[derive(Debug, clap::Args)]
pub(crate) struct Firmware {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Create a key pair, to sign images
    Keygen(sign::Keygen),
    /// Sign an image, and write the file for the update to stdout
    Sign(sign::Sign),
    /// Show for which board a signed image is, and its version; with -k, verify it
    Show(sign::Show),
}

impl Firmware {
    pub(crate) fn run(self) -> Done {
        match self.action {
            Action::Keygen(keygen) => keygen.run(),
            Action::Sign(sign) => sign.run(),
            Action::Show(show) => show.run(),
        }
    }
}
