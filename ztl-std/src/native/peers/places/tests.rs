//! The rules one by one, then honest clients beside a crowd, on virtual time.

use std::collections::BinaryHeap;

use super::*;

const MS: Duration = Duration::from_millis(1);

fn at(ms: u32) -> Instant {
    Instant::ZERO + MS * ms
}

fn address(last: u8) -> IpAddr {
    IpAddr::from([127, 0, 0, last])
}

fn id(number: u64) -> PeerId {
    PeerId { slot: 0, number }
}

/// Strangers of this address, one each millisecond, with these numbers.
fn come(places: &mut Places, last: u8, numbers: std::ops::Range<u64>) {
    for number in numbers {
        places.add(at(number as u32), id(number), address(last));
    }
}

fn room(places: &Places, now: u32, last: u8) -> Room {
    places.room(at(now), address(last), |_| false, || None)
}

#[test]
fn the_address_with_the_most_strangers_pays() {
    let mut places = Places::new(20);
    come(&mut places, 1, 0..9);
    come(&mut places, 2, 9..10);
    assert_eq!(room(&places, 50, 1), Room::Free);
    come(&mut places, 1, 10..11);
    // Half of all are of one address, which pays for its own newcomers.
    assert_eq!(room(&places, 50, 1), Room::InsteadOf(id(10)));
    assert_eq!(room(&places, 50, 3), Room::Free);
    come(&mut places, 3, 11..20);
    // Also for those of others when all places are taken. Two addresses have most, and the last to come was of the other.
    for last in [2, 3, 4] {
        assert_eq!(room(&places, 50, last), Room::InsteadOf(id(19)));
    }
    for number in 11..16 {
        places.remove_stranger(id(number), address(3));
    }
    come(&mut places, 4, 20..25);
    assert_eq!(room(&places, 50, 5), Room::InsteadOf(id(24)));
    for number in 20..22 {
        places.remove_stranger(id(number), address(4));
    }
    come(&mut places, 5, 25..27);
    // Only those of the first address have more than twice as many as the others.
    assert_eq!(room(&places, 50, 6), Room::InsteadOf(id(10)));
}

#[test]
fn the_older_half_stays_while_its_handshakes_go_on() {
    let mut places = Places::new(16);
    come(&mut places, 1, 0..8);
    assert_eq!(room(&places, 99, 1), Room::InsteadOf(id(7)));
    assert_eq!(room(&places, 100, 1), Room::InsteadOf(id(0)));
    places.advance(at(99), id(0), address(1), Stage::Greeted);
    assert_eq!(room(&places, 100, 1), Room::InsteadOf(id(7)));
    assert_eq!(room(&places, 101, 1), Room::InsteadOf(id(1)));
    // Bytes that go no further do not count.
    places.advance(at(200), id(0), address(1), Stage::Greeted);
    for number in 1..4 {
        places.advance(at(200), id(number), address(1), Stage::Greeted);
    }
    assert_eq!(room(&places, 299, 1), Room::InsteadOf(id(0)));
    places.advance(at(298), id(0), address(1), Stage::Opened);
    // Of the younger half, too.
    assert_eq!(room(&places, 299, 1), Room::InsteadOf(id(4)));
}

#[test]
fn of_the_younger_half_the_fullest_stage_makes_room() {
    let mut places = Places::new(16);
    come(&mut places, 1, 0..8);
    for number in [5, 7] {
        places.advance(at(10), id(number), address(1), Stage::Greeted);
    }
    // As many have greeted as not.
    assert_eq!(room(&places, 50, 1), Room::InsteadOf(id(6)));
    places.advance(at(11), id(6), address(1), Stage::Greeted);
    assert_eq!(room(&places, 50, 1), Room::InsteadOf(id(7)));
    for number in [5, 6, 7] {
        places.advance(at(12), id(number), address(1), Stage::Opened);
    }
    assert_eq!(room(&places, 50, 1), Room::InsteadOf(id(7)));
}

#[test]
fn each_has_its_time_and_who_has_unread_bytes_stays() {
    let mut places = Places::new(16);
    come(&mut places, 1, 0..8);
    assert_eq!(room(&places, 8, 1), Room::None);
    // The last one at its stage stays.
    assert_eq!(room(&places, 9, 1), Room::None);
    assert_eq!(room(&places, 10, 1), Room::InsteadOf(id(5)));
    assert_eq!(room(&places, 11, 1), Room::InsteadOf(id(6)));
    let has_unread = |one: PeerId| one.number >= 6;
    let found = places.room(at(50), address(1), has_unread, || None);
    assert_eq!(found, Room::InsteadOf(id(5)));
    // Who has greeted has more time.
    for number in 0..8 {
        places.advance(at(8), id(number), address(1), Stage::Greeted);
    }
    assert_eq!(room(&places, 24, 1), Room::None);
    assert_eq!(room(&places, 25, 1), Room::InsteadOf(id(5)));
}

#[test]
fn known_clients_keep_their_places() {
    let mut places = Places::new(10);
    come(&mut places, 1, 0..5);
    for number in 0..5 {
        places.admit(id(number), address(1));
    }
    come(&mut places, 2, 5..10);
    for number in 5..10 {
        places.admit(id(number), address(2));
    }
    assert_eq!(room(&places, 1000, 3), Room::None);
    places.remove_known();
    assert_eq!(room(&places, 1000, 3), Room::Free);
    come(&mut places, 3, 10..11);
    assert_eq!(room(&places, 1000, 3), Room::InsteadOf(id(10)));
    places.remove_stranger(id(10), address(3));
    assert_eq!(room(&places, 1000, 3), Room::Free);
}

/// How often an honest client connects.
const TRIES: usize = 20;

/// When a client reaches its stages after it has connected, in milliseconds; the last one is the end of its handshake.
type Handshake = &'static [u32];

/// Through something that connects at once and delays bytes by 50 ms, and over a network that needs as long.
const DELAYED_KEYS: Handshake = &[50, 150, 250];
const DELAYED_OPEN: Handshake = &[50, 150];
const FAR_KEYS: Handshake = &[0, 100, 200];
const FAR_OPEN: Handshake = &[0, 100];
const NEAR: Handshake = &[0, 1, 2];

/// What strangers do who never finish.
const SILENT: Handshake = &[];
const GREETS: Handshake = &[1];
const OPENS: Handshake = &[1, 2];
/// As late as they may without losing their place.
const CUNNING: Handshake = &[190, 380];

/// Pseudo-random numbers, the same each time (xorshift).
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % limit
    }
}

/// What happens at a microsecond.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    /// A stranger of the crowd connects.
    Crowd,
    /// The honest client connects.
    Honest,
    /// This one reaches its next stage.
    Reaches(u64, usize),
}

/// A server with 50 places, 500 strangers a second from some addresses, and a client at the first of them.
struct World {
    places: Places,
    of: BTreeMap<u64, (IpAddr, Handshake)>,
    events: BinaryHeap<std::cmp::Reverse<(u64, Event)>>,
    random: Random,
    next_number: u64,
    /// The honest client's connection.
    honest: Option<u64>,
}

impl World {
    fn add(&mut self, now: u64, address: IpAddr, handshake: Handshake) -> Option<u64> {
        let moment = Instant::ZERO + Duration::from_micros(now);
        match self.places.room(moment, address, |_| false, || None) {
            Room::Free => {}
            Room::None => return None,
            Room::InsteadOf(id) => {
                let (address, _) = self.of.remove(&id.number).expect("a stranger");
                self.places.remove_stranger(id, address);
            }
        }
        let number = self.next_number;
        self.next_number += 1;
        self.places.add(moment, id(number), address);
        self.of.insert(number, (address, handshake));
        self.reach(now, number, 0);
        Some(number)
    }

    fn reach(&mut self, connected: u64, number: u64, step: usize) {
        if let Some((_, handshake)) = self.of.get(&number)
            && let Some(after) = handshake.get(step)
        {
            let before = step.checked_sub(1).map_or(0, |before| handshake[before]);
            let then = connected + u64::from(after - before) * 1000;
            self.at(then, Event::Reaches(number, step));
        }
    }

    fn at(&mut self, then: u64, event: Event) {
        self.events.push(std::cmp::Reverse((then, event)));
    }

    /// How long the client takes to connect, again and again, in milliseconds, sorted.
    fn times(crowd: Handshake, batch: u64, addresses: u64, honest: Handshake) -> Vec<u64> {
        let mut world = Self {
            places: Places::new(50),
            of: BTreeMap::new(),
            events: BinaryHeap::new(),
            random: Random(7),
            next_number: 0,
            honest: None,
        };
        world.at(0, Event::Crowd);
        world.at(1_000_000, Event::Honest);
        let (mut times, mut began, mut pause) = (Vec::new(), 1_000_000, 20_000);
        while times.len() < TRIES {
            let Some(std::cmp::Reverse((now, event))) = world.events.pop() else {
                panic!("nothing happens");
            };
            match event {
                Event::Crowd => {
                    let pause = 1000 + world.random.below(2000);
                    world.at(now + batch * pause, Event::Crowd);
                    for _ in 0..batch {
                        let from = address(1 + world.random.below(addresses) as u8);
                        world.add(now, from, crowd);
                    }
                }
                Event::Honest => world.honest = world.add(now, address(1), honest),
                Event::Reaches(number, step) => {
                    let Some(&(address, handshake)) = world.of.get(&number) else {
                        continue;
                    };
                    if world.honest == Some(number) && step + 1 == handshake.len() {
                        // Its place is free again.
                        world.places.remove_stranger(id(number), address);
                        world.of.remove(&number);
                        world.honest = None;
                        times.push((now - began) / 1000);
                        began = now + world.random.below(1_000_000);
                        pause = 20_000;
                        world.at(began, Event::Honest);
                        continue;
                    }
                    let stage = [Stage::Greeted, Stage::Opened][step];
                    let moment = Instant::ZERO + Duration::from_micros(now);
                    world.places.advance(moment, id(number), address, stage);
                    world.reach(now, number, step + 1);
                }
            }
            // It learns that it was displaced or turned away, and comes again, as our client does.
            let lost = world.honest.is_none_or(|one| !world.of.contains_key(&one));
            let waits = world.events.iter().any(|event| event.0.1 == Event::Honest);
            if lost && !waits {
                world.honest = None;
                world.at(now + 50_000 + pause, Event::Honest);
                pause = (2 * pause).min(1_000_000);
            }
        }
        times.sort_unstable();
        times
    }
}

/// Whoever is honest connects beside 500 strangers a second, whatever they say and wherever they come from.
#[test]
fn a_crowd_locks_out_nobody() {
    let crowds = [
        ("silent", SILENT),
        ("greets", GREETS),
        ("opens", OPENS),
        ("cunning", CUNNING),
    ];
    let clients = [
        ("delayed, keys", DELAYED_KEYS),
        ("delayed, open", DELAYED_OPEN),
        ("far, keys", FAR_KEYS),
        ("far, open", FAR_OPEN),
        ("near", NEAR),
    ];
    // One by one, and as many as the server accepts at once.
    for (addresses, batch) in [(1, 1), (1, 10), (5, 1), (100, 1), (100, 10)] {
        for (says, crowd) in crowds {
            for (who, honest) in clients {
                let times = World::times(crowd, batch, addresses, honest);
                let (median, most) = (times[TRIES / 2], times[TRIES * 9 / 10]);
                println!(
                    "{addresses} addresses, {batch} at once, {says}; {who}: {median} ms, 90 % {most} ms"
                );
                assert!(median <= 2000 && most <= 15_000, "{times:?}");
            }
        }
    }
}
