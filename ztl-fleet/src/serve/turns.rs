//! Requests that wait for the endpoint's rules: each connection has its turn, and within it each robot.
//!
//! To one robot, so many requests may be under way that the robot's agent has room for others, and of one connection at most as
//! many as are free: one has half of the room, of two each a third, and there is always some for the next one. Further ones
//! wait, as long as a client does: an INIT must not act later. If too many wait, the connection with the most of them loses its
//! newest.

use std::collections::{HashMap, VecDeque};

use ztl_core::Instant;

use crate::endpoint::LONGEST;

/// Most requests that wait.
const MOST: usize = 1000;

/// Where a request comes from, and which robot it is for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Origin {
    pub(super) connection: u64,
    /// Empty for a request to the endpoint itself.
    pub(super) robot: String,
}

/// A request whose turn it is.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Taken<R> {
    pub(super) origin: Origin,
    pub(super) arrived: Instant,
    pub(super) request: R,
}

/// Requests of type `R`.
#[derive(Debug)]
pub(super) struct Turns<R> {
    /// Most requests that are under way to one robot.
    room: usize,
    clients: HashMap<u64, Client<R>>,
    robots: HashMap<String, Robot>,
    /// Connections with a request that may be taken.
    ready: VecDeque<u64>,
    waiting: usize,
}

/// What is under way to a robot.
#[derive(Debug, Default)]
struct Robot {
    under_way: usize,
    /// Connections that wait for room; the first one has waited the longest.
    blocked: VecDeque<u64>,
}

/// A connection.
#[derive(Debug)]
struct Client<R> {
    lines: HashMap<String, Line<R>>,
    /// Robots for which a request may be taken.
    ready: VecDeque<String>,
    waiting: usize,
}

/// The requests of a connection to one robot.
#[derive(Debug)]
struct Line<R> {
    waiting: VecDeque<(Instant, R)>,
    under_way: usize,
    is_ready: bool,
}

impl<R> Turns<R> {
    pub(super) fn new(room: usize) -> Self {
        Self {
            room,
            clients: HashMap::new(),
            robots: HashMap::new(),
            ready: VecDeque::new(),
            waiting: 0,
        }
    }

    /// Whether no request may be taken.
    pub(super) fn is_quiet(&self) -> bool {
        self.ready.is_empty()
    }

    /// Adds a request, unless too many wait.
    pub(super) fn put(&mut self, now: Instant, origin: &Origin, request: R) {
        if self.waiting >= MOST && !self.displace(origin.connection) {
            return;
        }
        let client = self.clients.entry(origin.connection).or_insert(Client {
            lines: HashMap::new(),
            ready: VecDeque::new(),
            waiting: 0,
        });
        let line = client.lines.entry(origin.robot.clone());
        let line = line.or_insert(Line {
            waiting: VecDeque::new(),
            under_way: 0,
            is_ready: false,
        });
        line.waiting.push_back((now, request));
        client.waiting += 1;
        self.waiting += 1;
        self.make_ready(origin);
    }

    /// The next request that has not waited for too long. [`end`](Self::end) must follow.
    pub(super) fn take(&mut self, now: Instant) -> Option<Taken<R>> {
        loop {
            let connection = self.ready.pop_front()?;
            let client = self.clients.get_mut(&connection)?;
            let robot = client.ready.pop_front()?;
            let line = client.lines.get_mut(&robot)?;
            line.is_ready = false;
            let has_room = has_room(
                self.room,
                &mut self.robots,
                &robot,
                connection,
                line.under_way,
            );
            let before = line.waiting.len();
            while let Some((arrived, _)) = line.waiting.front()
                && now.since(*arrived) >= LONGEST
            {
                line.waiting.pop_front();
            }
            let next = has_room.then(|| line.waiting.pop_front()).flatten();
            line.under_way += usize::from(next.is_some());
            if let Some(known) = self.robots.get_mut(&robot) {
                known.under_way += usize::from(next.is_some());
            }
            let taken = before - line.waiting.len();
            client.waiting -= taken;
            self.waiting -= taken;
            if !client.ready.is_empty() {
                self.ready.push_back(connection);
            }
            let origin = Origin { connection, robot };
            self.make_ready(&origin);
            self.forget_idle(&origin);
            if let Some((arrived, request)) = next {
                return Some(Taken {
                    origin,
                    arrived,
                    request,
                });
            }
        }
    }

    /// A request is not under way any more.
    pub(super) fn end(&mut self, origin: &Origin) {
        let Some(client) = self.clients.get_mut(&origin.connection) else {
            return;
        };
        let Some(line) = client.lines.get_mut(&origin.robot) else {
            return;
        };
        line.under_way = line.under_way.saturating_sub(1);
        let Some(robot) = self.robots.get_mut(&origin.robot) else {
            return;
        };
        robot.under_way = robot.under_way.saturating_sub(1);
        let free = self.room.saturating_sub(robot.under_way);
        if !robot.blocked.contains(&origin.connection) {
            robot.blocked.push_back(origin.connection);
        }
        // Those that have waited the longest are the next ones, as many as there is room for.
        let (mut left, mut released) = (free, Vec::new());
        let clients = &self.clients;
        robot.blocked.retain(|connection| {
            let client = clients.get(connection);
            let line = client.and_then(|client| client.lines.get(&origin.robot));
            let waits = line.filter(|line| !line.waiting.is_empty());
            let stays = waits.is_some_and(|line| left == 0 || line.under_way >= free);
            left -= usize::from(waits.is_some() && !stays);
            if !stays {
                released.push(*connection);
            }
            stays
        });
        for connection in released {
            let robot = origin.robot.clone();
            let released = Origin { connection, robot };
            self.make_ready(&released);
            self.forget_idle(&released);
        }
    }

    /// Gives a line its turn if a request of it may be taken.
    fn make_ready(&mut self, Origin { connection, robot }: &Origin) {
        let Some(client) = self.clients.get_mut(connection) else {
            return;
        };
        let Some(line) = client.lines.get_mut(robot) else {
            return;
        };
        if line.is_ready || line.waiting.is_empty() {
            return;
        }
        if !has_room(
            self.room,
            &mut self.robots,
            robot,
            *connection,
            line.under_way,
        ) {
            return;
        }
        line.is_ready = true;
        if client.ready.is_empty() {
            self.ready.push_back(*connection);
        }
        client.ready.push_back(robot.clone());
    }

    fn forget_idle(&mut self, Origin { connection, robot }: &Origin) {
        let Some(client) = self.clients.get_mut(connection) else {
            return;
        };
        let line = client.lines.get(robot);
        if line.is_some_and(|line| line.waiting.is_empty() && line.under_way == 0 && !line.is_ready)
        {
            client.lines.remove(robot);
        }
        if client.lines.is_empty() {
            self.clients.remove(connection);
        }
        let known = self.robots.get(robot);
        if known.is_some_and(|known| known.under_way == 0 && known.blocked.is_empty()) {
            self.robots.remove(robot);
        }
    }

    /// Drops the newest request of the connection with the most, if those are more than this connection's.
    fn displace(&mut self, connection: u64) -> bool {
        let own = self.clients.get(&connection);
        let own = own.map_or(0, |client| client.waiting);
        let clients = self.clients.values_mut();
        let Some(most) = clients.max_by_key(|client| client.waiting) else {
            return false;
        };
        if most.waiting <= own {
            return false;
        }
        let lines = most.lines.values_mut();
        let longest = lines.max_by_key(|line| line.waiting.len());
        let dropped = longest.and_then(|line| line.waiting.pop_back());
        let count = usize::from(dropped.is_some());
        most.waiting -= count;
        self.waiting -= count;
        dropped.is_some()
    }
}

/// Whether a connection, of which so many are under way, may have one more; otherwise it waits for room.
fn has_room(
    room: usize,
    robots: &mut HashMap<String, Robot>,
    robot: &str,
    connection: u64,
    under_way: usize,
) -> bool {
    if !robots.contains_key(robot) {
        robots.insert(robot.to_owned(), Robot::default());
    }
    let Some(known) = robots.get_mut(robot) else {
        return false;
    };
    let has_room = under_way < room.saturating_sub(known.under_way);
    if !has_room && !known.blocked.contains(&connection) {
        known.blocked.push_back(connection);
    }
    has_room
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of one connection, half of the room.
    const WINDOW: usize = 3;
    const ROOM: usize = 2 * WINDOW;

    fn origin(connection: u64, robot: &str) -> Origin {
        let robot = robot.to_owned();
        Origin { connection, robot }
    }

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    /// So many requests, whose numbers begin at 0.
    fn put(turns: &mut Turns<u32>, connection: u64, robot: &str, count: u32) {
        for number in 0..count {
            turns.put(at(0), &origin(connection, robot), number);
        }
    }

    /// Takes all that may be taken: connection, robot, number.
    fn take(turns: &mut Turns<u32>, now: u64) -> Vec<(u64, String, u32)> {
        let taken = std::iter::from_fn(|| turns.take(at(now)));
        let told = |taken: Taken<u32>| {
            let Origin { connection, robot } = taken.origin;
            (connection, robot, taken.request)
        };
        taken.map(told).collect()
    }

    #[test]
    fn connections_take_turns_and_their_robots_too() {
        let mut turns = Turns::new(ROOM);
        put(&mut turns, 1, "arm", 100);
        put(&mut turns, 1, "leg", 1);
        put(&mut turns, 2, "arm", 2);
        let taken = [
            (1, "arm", 0),
            (2, "arm", 0),
            (1, "leg", 0),
            (2, "arm", 1),
            (1, "arm", 1),
        ];
        let taken = taken.map(|(connection, robot, number)| (connection, robot.to_owned(), number));
        assert_eq!(take(&mut turns, 0), taken);
        assert!(turns.is_quiet());
        // Room comes back with each end, also with another connection's, in order.
        turns.end(&origin(2, "arm"));
        assert_eq!(take(&mut turns, 0), [(1, "arm".to_owned(), 2)]);
        turns.end(&origin(2, "arm"));
        assert!(turns.is_quiet(), "half of the room is taken");
        for number in 3..6 {
            turns.end(&origin(1, "arm"));
            assert_eq!(take(&mut turns, 0), [(1, "arm".to_owned(), number)]);
        }
    }

    #[test]
    fn what_has_waited_for_too_long_is_dropped() {
        let mut turns = Turns::new(ROOM);
        put(&mut turns, 1, "arm", 10);
        assert_eq!(take(&mut turns, 0).len(), WINDOW);
        turns.put(at(500), &origin(1, "arm"), 77);
        turns.end(&origin(1, "arm"));
        assert_eq!(take(&mut turns, 1900), [(1, "arm".to_owned(), 77)]);
        turns.put(at(500), &origin(1, "arm"), 78);
        turns.end(&origin(1, "arm"));
        assert_eq!(take(&mut turns, 2400), []);
        assert_eq!(turns.waiting, 0);
    }

    #[test]
    fn a_flood_is_bounded_and_displaces_no_other_connection() {
        let mut turns = Turns::new(ROOM);
        put(&mut turns, 1, "arm", 5000);
        put(&mut turns, 2, "arm", 2);
        for robot in 0..5000 {
            put(&mut turns, 1, &format!("robot-{robot}"), 1);
        }
        assert_eq!(turns.waiting, MOST);
        put(&mut turns, 3, "leg", 1);
        assert_eq!(turns.waiting, MOST);
        let taken: Vec<u64> = take(&mut turns, 0).iter().map(|taken| taken.0).collect();
        assert_eq!(taken[..3], [1, 2, 3]);
        assert_eq!(
            taken.iter().filter(|connection| **connection == 2).count(),
            2
        );
    }

    #[test]
    fn nothing_is_kept_of_who_waits_for_nothing() {
        let mut turns = Turns::new(ROOM);
        for connection in 0..10 {
            put(&mut turns, connection, "arm", 2);
            put(&mut turns, connection, "leg", 1);
        }
        let mut taken = take(&mut turns, 0);
        let mut count = 0;
        while !taken.is_empty() {
            count += taken.len();
            for (connection, robot, _) in taken {
                turns.end(&origin(connection, &robot));
            }
            taken = take(&mut turns, 0);
        }
        assert_eq!(count, 30);
        let left = (turns.clients.len(), turns.ready.len(), turns.robots.len());
        assert_eq!(left, (0, 0, 0));
        // Nor of what was dropped before its turn.
        put(&mut turns, 1, "arm", 5);
        assert_eq!(take(&mut turns, 5000), []);
        let left = (turns.clients.len(), turns.ready.len(), turns.robots.len());
        assert_eq!(left, (0, 0, 0));
    }

    #[test]
    fn connections_that_wait_for_room_have_it_in_turn() {
        let mut turns = Turns::new(4);
        for connection in 0..20 {
            put(&mut turns, connection, "arm", 5);
        }
        let mut counts = [0_u32; 20];
        let mut under_way = VecDeque::from(take(&mut turns, 0));
        while let Some((connection, robot, number)) = under_way.pop_front() {
            counts[usize::try_from(connection).unwrap()] = number + 1;
            let least = counts.iter().min().unwrap();
            assert!(number <= least + 2, "{counts:?}");
            turns.end(&origin(connection, &robot));
            under_way.extend(take(&mut turns, 0));
        }
        assert_eq!(counts, [5; 20]);
    }

    #[test]
    fn floods_of_several_connections_leave_room_at_their_robot_for_the_next_one() {
        let mut turns = Turns::new(128);
        for connection in 1..=10 {
            put(&mut turns, connection, "arm", 90);
        }
        assert!(take(&mut turns, 0).len() < 128);
        put(&mut turns, 11, "arm", 1);
        assert_eq!(take(&mut turns, 0), [(11, "arm".to_owned(), 0)]);
        // Nor do they take what other robots have.
        put(&mut turns, 12, "leg", 64);
        assert_eq!(take(&mut turns, 0).len(), 64);
    }
}
