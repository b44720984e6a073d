//! The robot as a server for ZeroMQ clients over TCP: a network stack below, the server above.

use embedded_hal::digital::{InputPin, OutputPin};
use embedded_hal::pwm::SetDutyCycle;
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet, SocketStorage};
use smoltcp::phy::Device;
use smoltcp::socket::tcp::{Socket, SocketBuffer, State};
use smoltcp::time::{Duration, Instant as StackInstant};
use smoltcp::wire::{EthernetAddress, HardwareAddress, IpCidr, Ipv4Address};
use ztl_mcu::zmtp::{Peer, Server};
use ztl_mcu::{Components, Instant};

use crate::{Board, FRAME, Pins, TASKS, poll_stop, server};

/// The TCP port.
pub const PORT: u16 = 7002;

/// Number of clients at a time. The stack refuses any other, which then retries.
const PEERS: usize = 2;
/// Size of the buffer in each direction of a connection.
const BUFFER: usize = 512;
/// After this time a client that was switched off is detected, and its slot is free.
const KEEP_ALIVE: Duration = Duration::from_secs(5);
const GONE: Duration = Duration::from_secs(15);

/// The network address of the board.
#[derive(Debug, Clone, Copy)]
pub struct Address {
    /// MAC address.
    pub mac: [u8; 6],
    /// IP address.
    pub ip: [u8; 4],
    /// Length of the network prefix in bits.
    pub prefix: u8,
}

/// Runs forever. The board's serial port is not used.
pub fn serve(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
    board: &mut impl Board,
    mut device: impl Device,
    address: Address,
) -> ! {
    let mut server = server::<PEERS>(boot, pins);
    let [a, b, c, d] = address.ip;
    let mac = HardwareAddress::Ethernet(EthernetAddress(address.mac));
    let mut config = Config::new(mac);
    config.random_seed = u64::from(boot);
    let mut interface = Interface::new(config, &mut device, stack_time(board.now()));
    interface.update_ip_addrs(|addresses| {
        let own = IpCidr::new(Ipv4Address::new(a, b, c, d).into(), address.prefix);
        // There is room for the first.
        let _ = addresses.push(own);
    });

    let mut buffers = [[[0; BUFFER]; 2]; PEERS];
    let mut storage = [SocketStorage::EMPTY; PEERS];
    let mut sockets = SocketSet::new(storage.as_mut_slice());
    let mut clients = buffers.each_mut().map(|[received, sent]| {
        let received = SocketBuffer::new(received.as_mut_slice());
        let mut socket = Socket::new(received, SocketBuffer::new(sent.as_mut_slice()));
        socket.set_nagle_enabled(false);
        socket.set_timeout(Some(GONE));
        (sockets.add(socket), false)
    });
    loop {
        let now = board.now();
        interface.poll(stack_time(now), &mut device, &mut sockets);
        for (place, (handle, served)) in clients.iter_mut().enumerate() {
            attend(&mut server, &mut sockets, (place, *handle), served, now);
        }
        server.handle_timeout(now);
        poll_stop(&mut server, board, now);
        let mut busy = false;
        for (place, (handle, _)) in clients.iter().enumerate() {
            busy |= send(&mut server, sockets.get_mut(*handle), Peer(place as u8));
        }
        if busy {
            interface.poll(stack_time(now), &mut device, &mut sockets);
        } else {
            board.sleep();
        }
    }
}

/// Handles input, connection and disconnection of a client.
fn attend<C: Components>(
    server: &mut Server<'_, C, PEERS, TASKS, FRAME, TASKS>,
    sockets: &mut SocketSet<'_>,
    (place, handle): (usize, SocketHandle),
    served: &mut bool,
    now: Instant,
) {
    let socket: &mut Socket<'_> = sockets.get_mut(handle);
    let peer = Peer(place as u8);
    match socket.state() {
        // The latter when it has gone again already.
        State::Established | State::CloseWait if !*served => {
            *served = true;
            server.open(now, peer);
        }
        // Only a socket that is closed fails to listen.
        State::Closed => {
            *served = false;
            server.close(peer);
            socket.set_keep_alive(Some(KEEP_ALIVE));
            let _ = socket.listen(PORT);
        }
        // The place is needed.
        State::TimeWait => socket.abort(),
        _ => {}
    }
    // What does not fit yet stays in the stack.
    while socket.can_recv() {
        let taken = socket.recv(|bytes| {
            let taken = server.handle_bytes(now, peer, bytes);
            (taken, taken)
        });
        send(server, socket, peer);
        if taken.unwrap_or_default() == 0 {
            break;
        }
    }
    if *served && !(socket.may_recv() && server.is_open(peer)) {
        server.close(peer);
        // A client that does not close its end too would answer for ever, and keep its place.
        socket.set_keep_alive(None);
        socket.close();
    }
}

/// Sends pending output to a client, as far as it fits. Returns whether there was any.
fn send<C: Components>(
    server: &mut Server<'_, C, PEERS, TASKS, FRAME, TASKS>,
    socket: &mut Socket<'_>,
    peer: Peer,
) -> bool {
    let mut any = false;
    while socket.can_send() {
        let sent = socket.send_slice(server.transmit_buf(peer));
        let sent = sent.unwrap_or_default();
        if sent == 0 {
            break;
        }
        server.consume(peer, sent);
        any = true;
    }
    any
}

fn stack_time(now: Instant) -> StackInstant {
    StackInstant::from_micros(now.as_micros().cast_signed())
}
