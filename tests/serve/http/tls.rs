//! `https` and `wss`: certificates that are pinned, and those that are wrong.
