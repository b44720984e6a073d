//! A thread that panics ends the whole process, so that a supervisor can start it again. Without that, the process would go on
//! without this thread and look healthy. Zenoh's threads would catch the panic.

use std::io::Write as _;
use std::panic::{set_hook, take_hook};
use std::sync::atomic::{AtomicBool, Ordering};

/// Whether the process ends anyway.
static ENDS: AtomicBool = AtomicBool::new(false);

/// From now on, a panic ends the process as `kill -9` does, after it was reported.
pub(crate) fn end_process() {
    let report = take_hook();
    set_hook(Box::new(move |panic| {
        report(panic);
        if !ENDS.load(Ordering::Relaxed) {
            let thread = std::thread::current();
            let name = thread.name().unwrap_or("without a name");
            // Stderr may be closed.
            let _ = writeln!(
                std::io::stderr(),
                "ztl-fleet: the thread '{name}' panicked, so this process ends; please report this fault"
            );
            std::process::abort();
        }
    }));
}

/// The process ends now: its exit code is not changed any more.
pub(crate) fn forget() {
    ENDS.store(true, Ordering::Relaxed);
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;
    use std::process::Command;

    use super::*;

    #[test]
    fn a_thread_that_panics_ends_the_process_and_says_so() {
        const CHILD: &str = "ZTL_FLEET_PANICS";
        const ABORTED: i32 = 6;
        if std::env::var_os(CHILD).is_some() {
            end_process();
            let thread = std::thread::Builder::new().name("ztl-fleet-streams".to_owned());
            let thread = thread.spawn(|| panic!("this is a test")).unwrap();
            // The process ends meanwhile.
            let _ = thread.join();
            return;
        }
        let name = "panics::tests::a_thread_that_panics_ends_the_process_and_says_so";
        let mut child = Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", name, "--nocapture"]).env(CHILD, "");
        let ended = child.output().unwrap();
        assert_eq!(ended.status.signal(), Some(ABORTED), "{ended:?}");
        let told = String::from_utf8_lossy(&ended.stderr);
        for text in [
            "this is a test",
            "the thread 'ztl-fleet-streams' panicked, so this process ends",
        ] {
            assert!(told.contains(text), "{told}");
        }
    }
}
