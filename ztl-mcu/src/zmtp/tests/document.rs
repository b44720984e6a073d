//! The example bytes of `docs/zmtp.md` match the server.

use std::vec::Vec;

use super::{BOTH, Client, End, NOW, Pieces, server};
use crate::zmtp::Peer;

const DOCUMENT: &str = include_str!("../../../../docs/zmtp.md");

/// Parses `ff 7*00 "text"`, up to a `;` outside quotes.
#[track_caller]
fn bytes(line: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    // Every second piece is quoted.
    for (place, piece) in line.split('"').enumerate() {
        if place % 2 == 1 {
            bytes.extend(piece.as_bytes());
            continue;
        }
        let (piece, comment) = piece.split_once(';').unwrap_or((piece, ""));
        for word in piece.split_whitespace() {
            let (count, number) = word.split_once('*').unwrap_or(("1", word));
            let count = count.parse().expect("a count");
            let number = u8::from_str_radix(number, 16).expect("a byte in hexadecimal");
            bytes.extend(std::vec![number; count]);
        }
        if !comment.is_empty() {
            break;
        }
    }
    bytes
}

/// Plays a block; returns how many bytes were compared.
fn play(block: &str, pieces: Pieces) -> usize {
    let mut server = server();
    server.open(NOW, Peer(0));
    let mut client = Client {
        server: &mut server,
        peer: Peer(0),
    };
    let (mut heard, mut expected, mut compared) = (client.drain(), Vec::new(), 0);
    for line in block.lines() {
        match line.split_once(' ') {
            Some(("S", line)) => expected.extend(bytes(line)),
            Some(("C", line)) => {
                assert_eq!(heard, expected, "before {line}, of\n{block}");
                compared += heard.len();
                expected.clear();
                heard = client.talk(pieces, &bytes(line));
            }
            _ => {
                assert_eq!(line, "closed");
                assert!(!client.server.is_open(Peer(0)), "{block}");
            }
        }
    }
    assert_eq!(heard, expected, "at the end of\n{block}");
    compared + heard.len()
}

#[test]
fn the_documents_conversations_match_the_server() {
    let blocks = DOCUMENT.split("```zmtp\n").skip(1);
    let blocks: Vec<&str> = blocks
        .filter_map(|block| block.split("```").next())
        .collect();
    assert!(blocks.len() >= 8, "{}", blocks.len());
    for pieces in BOTH {
        for block in &blocks {
            assert!(play(block, pieces) >= 11);
        }
    }
}

/// Each clause names its source.
#[test]
fn every_clause_of_the_document_cites_its_source() {
    let (_, clauses) = DOCUMENT.split_once("## What it does").expect("the clauses");
    let (clauses, _) = clauses.split_once("## In bytes").expect("their end");
    let clauses: Vec<&str> = clauses.split("\n- [").skip(1).collect();
    assert!(clauses.len() > 20);
    for clause in clauses {
        let sourced = ["(37 ", "(23 ", "(15 ", "(28", "(26", "(ours"];
        let cites = sourced.iter().any(|source| clause.contains(source));
        assert!(cites, "[{clause}");
    }
}
