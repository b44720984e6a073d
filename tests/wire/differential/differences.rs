//! What libzmq 4.3.4 does otherwise.

/// A row of the table in `docs/zmtp.md`, and what shows it: the name of a case, what libzmq does, what ours does.
pub(super) struct Difference {
    pub(super) what: &'static str,
    pub(super) shown: &'static [(&'static str, &'static str, &'static str)],
}

/// In an outcome of the table.
pub(super) const ANSWER: &str = "1'' 0'/test;2;99;Invalid ID '99''";

/// What follows a client's `READY` at once.
pub(super) const TOGETHER_WITH_READY: [&str; 2] = ["a request together with READY", "READY twice"];

pub(super) const SERVED: &str = "3.1 READY ANSWER open";
const TWICE: &str = "3.1 READY ANSWER ANSWER open";
const OLD: &str = "2.0 ROUTER 0'' ANSWER open";
const CLOSED: &str = "closed";
const CLOSED_LATER: &str = "3.1 READY closed";
const MISMATCH: &str = "3.1 4'\u{5}ERROR\u{1e}ROUTER-takes-REQ,DEALER,ROUTER' closed";

/// Rows with a test of their own.
pub(super) const IDENTITY: &str = "two connections with the same identity";
pub(super) const TIME_TO_LIVE: &str = "a time to live, and then another frame";
pub(super) const END: &str = "the end of the stream right after a request";

pub(super) const DIFFERENCES: &[Difference] = &[
    Difference {
        what: "ZMTP 1.0, and what is not ZMTP",
        shown: &[
            (
                "1.0",
                "1'\u{1b}' +\\x00/test;2;99;Invalid ID \\'99\\' open",
                CLOSED,
            ),
            ("revision 0", "2.0 ROUTER 1'' open", CLOSED),
            ("HTTP", "open", CLOSED),
            ("a first byte that is not FF", "open", CLOSED),
        ],
    },
    Difference {
        what: "version 2 in the greeting",
        shown: &[("revision 2", "3.1 open", OLD)],
    },
    Difference {
        what: "2.0: the socket type",
        shown: &[("2.0 by a SUB", OLD, "2.0 ROUTER 0'' closed")],
    },
    Difference {
        what: "2.0: an identity above 255 bytes",
        shown: &[("2.0 with a long identity", OLD, "2.0 ROUTER 0'' closed")],
    },
    Difference {
        what: "2.0: a command",
        shown: &[("2.0 with a command", OLD, "2.0 ROUTER 0'' closed")],
    },
    Difference {
        what: "a socket type that does not match",
        shown: &[
            ("REP", CLOSED, MISMATCH),
            ("SUB", CLOSED, MISMATCH),
            ("XSUB", CLOSED, MISMATCH),
            ("PUB", CLOSED, MISMATCH),
            ("XPUB", CLOSED, MISMATCH),
            ("PUSH", CLOSED, MISMATCH),
            ("PULL", CLOSED, MISMATCH),
            ("PAIR", CLOSED, MISMATCH),
            ("an unknown type", CLOSED, MISMATCH),
            ("an empty type", CLOSED, MISMATCH),
            ("two types", CLOSED, MISMATCH),
        ],
    },
    Difference {
        what: "`Socket-Type` is missing, or in other letters",
        shown: &[
            ("a SUB's name in small letters", SERVED, MISMATCH),
            ("no properties", SERVED, MISMATCH),
            ("only an identity", SERVED, MISMATCH),
        ],
    },
    Difference {
        what: "a command above 1,015 bytes in the handshake",
        shown: &[("a READY of 2,000 bytes", SERVED, CLOSED)],
    },
    Difference {
        what: "a frame after the client's `READY`, before the server's",
        shown: &[
            (TOGETHER_WITH_READY[0], CLOSED, TWICE),
            (TOGETHER_WITH_READY[1], CLOSED, SERVED),
        ],
    },
    Difference {
        what: "`READY` without the flag of a command",
        shown: &[("READY as a message", SERVED, CLOSED)],
    },
    Difference {
        what: "reserved flags, and MORE on a command",
        shown: &[
            ("READY with MORE", SERVED, CLOSED),
            ("READY with a reserved flag", SERVED, CLOSED),
            ("flag 8", SERVED, CLOSED_LATER),
            ("flag 16", SERVED, CLOSED_LATER),
            ("flag 32", SERVED, CLOSED_LATER),
            ("flag 64", SERVED, CLOSED_LATER),
            ("flag 128", SERVED, CLOSED_LATER),
            ("a command with MORE", SERVED, CLOSED_LATER),
        ],
    },
    Difference {
        what: "`SUBSCRIBE` to a ROUTER, within a message",
        shown: &[(
            "SUBSCRIBE within a message",
            "3.1 READY 1'' 0'\tSUBSCRIBEab;2;-1;Unknown protocol' ANSWER open",
            TWICE,
        )],
    },
    Difference {
        what: "`ERROR` after the handshake",
        shown: &[("ERROR after the handshake", SERVED, CLOSED_LATER)],
    },
    Difference {
        what: "a message whose frames take above 1,024 bytes more than the longest allowed one",
        shown: &[(
            "many addresses",
            "3.1 READY 40*1[100] ANSWER open",
            CLOSED_LATER,
        )],
    },
];
