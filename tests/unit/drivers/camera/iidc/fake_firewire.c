/* A FireWire bus with one IIDC camera, for LD_PRELOAD.
 *
 * Plays /dev/fw0 (the local node) and /dev/fw1 (a Point Grey Flea-like camera) at the interface of
 * <linux/firewire-cdev.h>, so that the real libdc1394 runs above it: configuration ROM, registers,
 * isochronous ring packet by packet, bus reset, cycle timer with a rate error, embedded image stamps, lost
 * packets and frames, unplug. Everything is in real time. A test talks to it through a shared file (struct rig),
 * named by VICAL_FAKE_FIREWIRE; the same layout is in vical_mocks/firewire_rig.py.
 *
 * An open node is one end of a socket pair: poll and read are the real ones.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/firewire-cdev.h>
#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define TRUTHS 4096
#define QUEUE 64
#define NODES 2
#define PACKETS 4096                 /* of one frame, at most */
#define CYCLE_NS 125000LL
#define NS 1000000000LL

struct truth { int64_t t_open_ns, t_close_ns; uint32_t counter, raw_shutter; };

struct rig {                     /* see vical_mocks/firewire_rig.py */
    uint32_t magic, unplugged, lose_frames, lose_packets, lose_at, bus_resets, no_embedding, no_bandwidth;
    uint32_t stopped;
    double ppm;
    int64_t cycle_offset_ns;
    uint32_t frames, opens, closes, sent;
    struct truth truth[TRUTHS];
};

struct buffer { uint8_t *data; uint32_t bytes, packets; };

struct client {
    int used, fd, peer, node, streaming;
    uint64_t reset_closure, iso_closure, resource_closure;
    void *memory; size_t memory_bytes;
    struct buffer queue[QUEUE]; unsigned head, tail;
    uint32_t filled;                                                  /* packets in the buffer at `head` */
    uint32_t headers[2 * PACKETS];
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_t camera_thread;
static int camera_running;
static struct rig *rig;
static struct client clients[64];
static uint32_t generation = 1, seen_resets, switched;
static int64_t jump_ns;
static uint32_t rom[2][64], rom_length[2];
static uint32_t regs[0x20000 / 4];

#define REG(offset) regs[(offset) / 4]
#define COMMANDS 0xF00000u

static int64_t now_ns(clockid_t id)
{
    struct timespec t;
    clock_gettime(id, &t);
    return t.tv_sec * NS + t.tv_nsec;
}

/* ---- the bus clock: 24.576 MHz with an error ---------------------------------------------------- */

static int64_t bus_ns(int64_t mono_ns)
{
    static int64_t origin;
    if (!origin) origin = mono_ns;
    double passed = (double)(mono_ns - origin) * (1 + rig->ppm * 1e-6);
    return (int64_t)passed + rig->cycle_offset_ns + jump_ns;
}

static uint32_t cycle_register(int64_t ns)
{
    int64_t wrapped = ((ns % (128 * NS)) + 128 * NS) % (128 * NS);
    uint32_t cycle = (uint32_t)(wrapped % NS / 125000);
    uint32_t offset = (uint32_t)(wrapped % 125000 * 3072 / 125000);
    return (uint32_t)(wrapped / NS) << 25 | cycle << 12 | offset;
}

/* ---- configuration ROMs and registers --------------------------------------------------------------- */

static unsigned put_leaf(uint32_t *out, unsigned at, const char *text)
{
    unsigned quads = (unsigned)(strlen(text) + 4) / 4;
    char padded[64] = {0};
    strcpy(padded, text);
    out[at] = (quads + 2) << 16;
    for (unsigned i = 0; i < quads; i++) {
        uint32_t word;
        memcpy(&word, padded + 4 * i, 4);
        out[at + 3 + i] = ntohl(word);
    }
    return at + 3 + quads;
}

static void make_roms(void)
{
    static const uint32_t local[] = {0x04040000, 0x31333934, 0xE0646000, 0x00001234, 0x56789ABC,
                                     0x00010000, 0x0C0083C0};
    static const uint32_t head[] = {
        0x04040000, 0x31333934, 0x0000A000, 0x00B09D01, 0x00A1B2C3,
        0x00030000, 0x0300B09D, 0x0C0083C0, 0xD1000001,              /* root; unit directory at 9 */
        0x00030000, 0x1200A02D, 0x13000102, 0xD4000001,              /* IIDC; dependent directory at 13 */
        0x00040000, 0x40000000 | COMMANDS / 4, 0x81000003, 0x8200000A, 0x38000010};
    memcpy(rom[0], local, sizeof local);
    rom_length[0] = sizeof local;
    memcpy(rom[1], head, sizeof head);
    unsigned end = put_leaf(rom[1], 18, "Point Grey Research");
    rom_length[1] = 4 * put_leaf(rom[1], end, "Flea fake");
}

static uint32_t float_bits(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, 4);
    return bits;
}

static float bits_float(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, 4);
    return value;
}

static void put_feature(unsigned index, unsigned absolute, float low, float high, float value)
{
    REG(0x500 + 4 * index) = 0xCF000000 | 1 << 12 | 4095;
    REG(0x700 + 4 * index) = (COMMANDS + absolute) / 4;
    REG(0x800 + 4 * index) = 0x83000000;                              /* present, on, automatic */
    REG(absolute) = float_bits(low);
    REG(absolute + 4) = float_bits(high);
    REG(absolute + 8) = float_bits(value);
}

static void reset_registers(void)
{
    memset(regs, 0, sizeof regs);
    switched++;
    REG(0x100) = 0xA1000000;                     /* formats 0, 2 and 7 */
    REG(0x180) = 0x04000000;                     /* 640x480 mono8 */
    REG(0x188) = 0x20000000;                     /* 1280x960 mono8 */
    REG(0x19C) = 0x80000000;                     /* Format7 mode 0 */
    REG(0x214) = 0x1C000000;                     /* 15, 30, 60 Hz */
    REG(0x248) = 0x18000000;                     /* 15, 30 Hz */
    REG(0x2E0) = (COMMANDS + 0xA00) / 4;
    REG(0x404) = 0x01810000;                     /* shutter, gain, frame rate */
    REG(0x600) = 4u << 29;
    REG(0x604) = 5u << 29;
    REG(0x60C) = 2u << 24;
    REG(0x630) = 8u << 24;
    put_feature(7, 0x910, 1e-5f, 0.030f, 0.008f);
    put_feature(8, 0x920, -6.0f, 24.0f, 0.0f);
    put_feature(15, 0x930, 1.0f, 120.0f, 30.0f);
    REG(0x81C) |= 800;
    REG(0x12F8) = rig->no_embedding ? 0 : 0x80000000;
    REG(0xA00) = 1280u << 16 | 960;
    REG(0xA04) = 8u << 16 | 2;
    REG(0xA0C) = 1280u << 16 | 960;
    REG(0xA14) = 0x80400000;                     /* mono8, raw8 */
    REG(0xA40) = 4u << 16 | 4096;
    REG(0xA44) = 4096u << 16 | 4096;
    REG(0xA54) = 8u << 24;
    REG(0xA58) = 0u << 24;                       /* RGGB */
}

static uint32_t frame_bytes(uint32_t *packet)
{
    static const uint32_t vga[] = {80, 160, 320, 640, 1280, 2560, 5120, 10240};
    static const uint32_t sxga[] = {320, 640, 1280, 2560, 5120, 10240, 20480, 0};
    uint32_t format = REG(0x608) >> 29, rate = REG(0x600) >> 29;
    if (format == 7) {
        *packet = REG(0xA44) >> 16;
        return (REG(0xA0C) >> 16) * (REG(0xA0C) & 0xFFFF);
    }
    *packet = (format == 2 ? sxga : vga)[rate];
    return format == 2 ? 1280 * 960 : 640 * 480;
}

static double frame_rate(void)
{
    if (REG(0x608) >> 29 == 7) return bits_float(REG(0x938));
    return 1.875 * (1 << (REG(0x600) >> 29));
}

static void derive(uint32_t offset)
{
    if (offset == 0x614) switched++;                                  /* transmission on or off */
    if (offset == 0x918 && REG(0x81C) & 0x40000000) {                 /* shutter in seconds: 10 us steps */
        uint32_t raw = (uint32_t)lround(bits_float(REG(0x918)) * 1e5);
        REG(0x81C) = (REG(0x81C) & 0xFFFFF000) | (raw & 0xFFF);
        REG(0x918) = float_bits((float)raw * 1e-5f);
    }
    if (offset == 0x12F8) REG(0x12F8) = rig->no_embedding ? 0 : 0x80000000 | (REG(0x12F8) & 0x3FF);
    if (offset >= 0xA00 && offset < 0xA80) {
        uint32_t packet, total = frame_bytes(&packet);
        total = (REG(0xA0C) >> 16) * (REG(0xA0C) & 0xFFFF);
        packet = REG(0xA44) >> 16;
        REG(0xA44) = packet << 16 | 4096;
        REG(0xA34) = REG(0xA3C) = total;
        REG(0xA48) = packet ? (total + packet - 1) / packet : 0;
    }
    if (offset == 0 && REG(0) & 0x80000000) reset_registers();
}

/* ---- events ------------------------------------------------------------------------------------------ */

static void post(struct client *c, const void *event, size_t bytes)
{
    send(c->peer, event, bytes, MSG_DONTWAIT | MSG_NOSIGNAL);
}

static void post_reset(struct client *c)
{
    struct fw_cdev_event_bus_reset e = {.closure = c->reset_closure, .type = FW_CDEV_EVENT_BUS_RESET,
        .node_id = 0xFFC1, .local_node_id = 0xFFC0, .root_node_id = 0xFFC1, .generation = generation};
    post(c, &e, sizeof e);
}

static void bus_reset(void)
{
    generation++;
    jump_ns += 12345678901LL;                                         /* another cycle master */
    for (unsigned i = 0; i < 64; i++)
        if (clients[i].used && clients[i].reset_closure != ~0ULL) post_reset(&clients[i]);
}

/* ---- the camera -------------------------------------------------------------------------------------- */

/* One packet, as the kernel's isochronous context takes it in: a buffer waits for the packet that begins a
 * frame (its sy bit), then packet after packet goes into its slots. It knows nothing of frames: after a lost
 * packet the rest moves up, and the first packet of the next frame fills the last slot. That frame is then
 * past its beginning, and the next buffer waits for the one after it. */
static void receive(struct client *c, const uint8_t *data, uint32_t bytes, int sync, int64_t t_bus_ns)
{
    if (c->head == c->tail || (!c->filled && !sync)) return;
    struct buffer *b = &c->queue[c->head % QUEUE];
    uint32_t slot = b->bytes / b->packets;
    memcpy(b->data + c->filled * slot, data, bytes < slot ? bytes : slot);
    c->headers[2 * c->filled] = htonl(bytes << 16 | 1 << 14 | 3 << 8 | 0xA << 4 | (uint32_t)sync);
    c->headers[2 * c->filled + 1] = htonl(cycle_register(t_bus_ns) >> 12 & 0xFFFF);
    if (++c->filled < b->packets) return;
    size_t length = 8 * b->packets;
    struct fw_cdev_event_iso_interrupt *e = calloc(1, sizeof *e + length);
    e->closure = c->iso_closure;
    e->type = FW_CDEV_EVENT_ISO_INTERRUPT;
    e->header_length = (uint32_t)length;
    memcpy(e->header, c->headers, length);
    e->cycle = ntohl(c->headers[2 * b->packets - 1]) & 0xFFFF;
    post(c, e, sizeof *e + length);
    free(e);
    c->head++;
    c->filled = 0;
    rig->sent++;
}

/* A picture whose row r shows counter + r everywhere, so that a row in the wrong place shows. */
static void draw(uint8_t *image, uint32_t width, uint32_t bytes, uint32_t counter, int64_t t_close, uint32_t raw)
{
    for (uint32_t at = 0; at < bytes; at++) image[at] = (uint8_t)((counter + at / width) & 0x7F);
    uint32_t info = REG(0x12F8);
    for (int item = 0; item < 10; item++)
        if (info >> item & 1) {
            uint32_t word = htonl(item == 0 ? (cycle_register(bus_ns(t_close)) & ~0xFu) | (counter & 0xF)
                                : item == 2 ? 0x82000000 | raw : item == 6 ? counter : 0);
            memcpy(image, &word, 4);
            image += 4;
        }
}

static void sleep_until(int64_t t_ns)
{
    struct timespec t = {t_ns / NS, t_ns % NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) { }
}

static int listens(const struct client *c)
{
    return c->used && c->streaming && !rig->unplugged && !rig->stopped && REG(0x614) & 0x80000000;
}

/* What the host's controller does in a while: unplugging and bus resets, and power lost. */
static void look_around(void)
{
    if (seen_resets != rig->bus_resets) { seen_resets = rig->bus_resets; bus_reset(); }
    for (unsigned i = 0; i < 64; i++)
        if (rig->unplugged && clients[i].used) shutdown(clients[i].peer, SHUT_RDWR);
    if (rig->unplugged) reset_registers();                            /* no power: everything forgotten */
}

static void *run_camera(void *unused)
{
    static uint8_t image[PACKETS * 4096];
    int64_t t_close = now_ns(CLOCK_MONOTONIC);
    uint32_t losing = 0;
    (void)unused;
    for (uint32_t counter = 1000;; counter++) {
        pthread_mutex_lock(&lock);
        uint32_t packet = 1, bytes = frame_bytes(&packet);
        uint32_t packets = packet ? (bytes + packet - 1) / packet : 1;
        int64_t period = (int64_t)(1e9 / frame_rate());
        int64_t apart = packets * CYCLE_NS < period ? CYCLE_NS : period / packets;
        uint32_t raw = REG(0x81C) & 0xFFF, sent = 0, begun = switched;
        uint32_t width = REG(0x608) >> 29 == 7 ? REG(0xA0C) >> 16 : REG(0x608) >> 29 == 2 ? 1280 : 640;
        pthread_mutex_unlock(&lock);
        int64_t late = now_ns(CLOCK_MONOTONIC) - t_close;
        t_close += late > NS ? late : period;                         /* held up for long: a pause of the bus */
        int64_t t_first = t_close + 1000000;                          /* first packet 1 ms later */
        while (sent < packets) {                                      /* in bunches, as interrupts come */
            uint32_t end = sent + 16 < packets ? sent + 16 : packets;
            sleep_until(t_first + end * apart);
            pthread_mutex_lock(&lock);
            look_around();
            int heard = 0;                                            /* a frame of the settings before is not sent */
            for (unsigned i = 0; i < 64 && begun == switched; i++) heard |= listens(&clients[i]);
            if (!sent) draw(image, width, packets * packet, counter, t_close, raw);
            if (!sent && heard)
                rig->truth[rig->frames++ % TRUTHS] = (struct truth){t_close - raw * 10000LL, t_close, counter, raw};
            for (; sent < end && heard; sent++) {
                if (!sent && rig->lose_frames) { rig->lose_frames--; losing = packets; }
                if (rig->lose_packets && sent == rig->lose_at) { losing = rig->lose_packets; rig->lose_packets = 0; }
                if (losing && losing--) continue;
                for (unsigned i = 0; i < 64; i++)
                    if (listens(&clients[i]))
                        receive(&clients[i], image + sent * packet, packet, !sent, bus_ns(t_first + sent * apart));
            }
            sent = end;
            pthread_mutex_unlock(&lock);
        }
    }
    return NULL;
}

/* ---- requests ---------------------------------------------------------------------------------------- */

static int transact(struct client *c, struct fw_cdev_send_request *r)
{
    struct { struct fw_cdev_event_response e; uint32_t more[64]; } response;
    uint32_t *data = (uint32_t *)(uintptr_t)r->data, *out = response.e.data;
    uint64_t offset = r->offset - 0xFFFFF0000000ULL;
    unsigned quads = r->length / 4;
    memset(&response, 0, sizeof response);
    response.e.closure = r->closure;
    response.e.type = FW_CDEV_EVENT_RESPONSE;
    if (r->generation != generation) response.e.rcode = 0x13;         /* RCODE_GENERATION */
    else if (quads > 32) response.e.rcode = 6;
    else for (unsigned i = 0; i < quads; i++, offset += 4) {
        int write = r->tcode < 4;
        if (offset >= 0x400 && offset < 0x400 + rom_length[1] && !write) out[i] = htonl(rom[1][(offset - 0x400) / 4]);
        else if (offset >= COMMANDS && offset < COMMANDS + sizeof regs) {
            uint32_t at = (uint32_t)(offset - COMMANDS);
            if (write) { REG(at) = ntohl(data[i]); derive(at); }
            else out[i] = htonl(REG(at));
        } else response.e.rcode = 7;                                  /* address error */
    }
    if (!response.e.rcode && r->tcode >= 4) response.e.length = r->length;
    post(c, &response, offsetof(struct fw_cdev_event_response, data) + response.e.length + 4);
    return 0;
}

static int queue_iso(struct client *c, struct fw_cdev_queue_iso *q)
{
    struct buffer b = {(uint8_t *)(uintptr_t)q->data, 0, 0};
    const struct fw_cdev_iso_packet *p = (const void *)(uintptr_t)q->packets;
    for (uint32_t i = 0; i < q->size / sizeof *p; i++) {
        b.bytes += p[i].control & 0xFFFF;
        b.packets += (p[i].control >> 24) / 8;
    }
    if (b.data < (uint8_t *)c->memory || b.data + b.bytes > (uint8_t *)c->memory + c->memory_bytes
        || !b.packets || b.packets > PACKETS || c->tail - c->head >= QUEUE) { errno = EINVAL; return -1; }
    c->queue[c->tail++ % QUEUE] = b;
    return 0;
}

static int get_info(struct client *c, struct fw_cdev_get_info *g)
{
    uint32_t length = rom_length[c->node];
    if (g->rom) memcpy((void *)(uintptr_t)g->rom, rom[c->node], g->rom_length < length ? g->rom_length : length);
    g->rom_length = length;
    g->version = 5;
    c->reset_closure = g->bus_reset_closure;
    if (g->bus_reset) {
        struct fw_cdev_event_bus_reset e = {.type = FW_CDEV_EVENT_BUS_RESET, .node_id = 0xFFC1,
            .local_node_id = 0xFFC0, .root_node_id = 0xFFC1, .generation = generation};
        memcpy((void *)(uintptr_t)g->bus_reset, &e, sizeof e);
    }
    return 0;
}

static int iso_resource(struct client *c, struct fw_cdev_allocate_iso_resource *r, uint32_t type)
{
    if (type == FW_CDEV_EVENT_ISO_RESOURCE_ALLOCATED) { c->resource_closure = r->closure; r->handle = 7; }
    int refuse = type == FW_CDEV_EVENT_ISO_RESOURCE_ALLOCATED && rig->no_bandwidth;
    struct fw_cdev_event_iso_resource e = {.closure = c->resource_closure, .type = type, .handle = 7,
        .channel = refuse ? -1 : 3, .bandwidth = refuse ? 0 : 1000};
    post(c, &e, sizeof e);
    return 0;
}

/* A clock, and the monotonic clock (mono_ns) at the same moment, ns. The kernel reads a clock and the cycle
 * timer with interrupts off; this process may be held up between two readings, and then reads again. */
static int64_t same_moment(clockid_t id, int64_t *mono_ns)
{
    int64_t shown, after;
    do {
        *mono_ns = now_ns(CLOCK_MONOTONIC);
        shown = now_ns(id);
        after = now_ns(CLOCK_MONOTONIC);
    } while (after - *mono_ns > 20000);
    return shown;
}

static int cycle_timer2(struct fw_cdev_get_cycle_timer2 *t)
{
    int64_t mono, shown = same_moment(t->clk_id == CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC, &mono);
    t->tv_sec = shown / NS;
    t->tv_nsec = (int32_t)(shown % NS);
    t->cycle_timer = cycle_register(bus_ns(mono));
    return 0;
}

static int handle(struct client *c, unsigned long request, void *argument)
{
    if (rig->unplugged && c->node == 1) { errno = ENODEV; return -1; }
    switch (request) {
    case FW_CDEV_IOC_GET_INFO: return get_info(c, argument);
    case FW_CDEV_IOC_SEND_REQUEST: return transact(c, argument);
    case FW_CDEV_IOC_INITIATE_BUS_RESET: bus_reset(); return 0;
    case FW_CDEV_IOC_CREATE_ISO_CONTEXT:
        c->iso_closure = ((struct fw_cdev_create_iso_context *)argument)->closure;
        ((struct fw_cdev_create_iso_context *)argument)->handle = 0;
        return 0;
    case FW_CDEV_IOC_QUEUE_ISO: return queue_iso(c, argument);
    case FW_CDEV_IOC_START_ISO:
        c->streaming = 1;
        if (!camera_running) camera_running = !pthread_create(&camera_thread, NULL, run_camera, NULL);
        return 0;
    case FW_CDEV_IOC_STOP_ISO: c->streaming = 0; c->filled = 0; return 0;
    case FW_CDEV_IOC_ALLOCATE_ISO_RESOURCE: return iso_resource(c, argument, FW_CDEV_EVENT_ISO_RESOURCE_ALLOCATED);
    case FW_CDEV_IOC_DEALLOCATE_ISO_RESOURCE: return iso_resource(c, argument, FW_CDEV_EVENT_ISO_RESOURCE_DEALLOCATED);
    case FW_CDEV_IOC_GET_CYCLE_TIMER: {
        struct fw_cdev_get_cycle_timer *t = argument;
        int64_t mono;
        t->local_time = (uint64_t)(same_moment(CLOCK_REALTIME, &mono) / 1000);
        t->cycle_timer = cycle_register(bus_ns(mono));
        return 0;
    }
    case FW_CDEV_IOC_GET_CYCLE_TIMER2: return cycle_timer2(argument);
    default: errno = ENOTTY; return -1;
    }
}

/* ---- what is interposed ------------------------------------------------------------------------------ */

__attribute__((constructor)) static void attach(void)
{
    const char *path = getenv("VICAL_FAKE_FIREWIRE");
    int fd = path ? (int)syscall(SYS_openat, AT_FDCWD, path, O_RDWR | O_CLOEXEC) : -1;
    if (fd < 0) return;
    rig = (void *)syscall(SYS_mmap, NULL, sizeof *rig, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    syscall(SYS_close, fd);
    if (rig == MAP_FAILED) { rig = NULL; return; }
    bus_ns(now_ns(CLOCK_MONOTONIC));
    make_roms();
    reset_registers();
}

static struct client *find(int fd)
{
    for (unsigned i = 0; rig && i < 64; i++)
        if (clients[i].used && clients[i].fd == fd) return &clients[i];
    return NULL;
}

static int open_node(const char *path)
{
    int node = path[7] - '0', pair[2];
    if (path[8] || node < 0 || node >= NODES) { errno = ENOENT; return -1; }
    if (node == 1 && rig->unplugged) { errno = ENOENT; return -1; }
    if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair)) return -1;
    int big = 4 << 20;
    setsockopt(pair[1], SOL_SOCKET, SO_SNDBUF, &big, sizeof big);
    pthread_mutex_lock(&lock);
    for (unsigned i = 0; i < 64; i++)
        if (!clients[i].used) {
            clients[i] = (struct client){.used = 1, .fd = pair[0], .peer = pair[1], .node = node,
                                         .reset_closure = ~0ULL};
            break;
        }
    rig->opens++;
    pthread_mutex_unlock(&lock);
    return pair[0];
}

static int open_any(int dir, const char *path, int flags, mode_t mode)
{
    if (rig && !strncmp(path, "/dev/fw", 7)) return open_node(path);
    return (int)syscall(SYS_openat, dir, path, flags, mode);
}

#define MODE(flags, last) mode_t mode = 0; \
    if ((flags) & (O_CREAT | __O_TMPFILE)) { va_list a; va_start(a, last); mode = va_arg(a, mode_t); va_end(a); }

int open(const char *path, int flags, ...) { MODE(flags, flags) return open_any(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags, flags) return open_any(AT_FDCWD, path, flags | O_LARGEFILE, mode); }
int openat(int dir, const char *path, int flags, ...) { MODE(flags, flags) return open_any(dir, path, flags, mode); }
int openat64(int dir, const char *path, int flags, ...) { MODE(flags, flags) return open_any(dir, path, flags | O_LARGEFILE, mode); }

int close(int fd)
{
    pthread_mutex_lock(&lock);
    struct client *c = find(fd);
    if (c) {
        syscall(SYS_close, c->peer);
        c->used = 0;
        rig->closes++;
    }
    int result = (int)syscall(SYS_close, fd);
    pthread_mutex_unlock(&lock);
    return result;
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list a;
    va_start(a, request);
    void *argument = va_arg(a, void *);
    va_end(a);
    pthread_mutex_lock(&lock);
    struct client *c = find(fd);
    int result = c ? handle(c, request, argument) : 0;
    pthread_mutex_unlock(&lock);
    return c ? result : (int)syscall(SYS_ioctl, fd, request, argument);
}

void *mmap(void *address, size_t length, int protection, int flags, int fd, off_t offset)
{
    struct client *c = fd >= 0 ? find(fd) : NULL;
    if (c) { fd = -1; flags = MAP_SHARED | MAP_ANONYMOUS; protection |= PROT_WRITE; }
    void *memory = (void *)syscall(SYS_mmap, address, length, protection, flags, fd, offset);
    if (c) { c->memory = memory; c->memory_bytes = length; }
    return memory;
}
void *mmap64(void *a, size_t n, int p, int f, int fd, off_t o) { return mmap(a, n, p, f, fd, o); }

static DIR *devices;
static int listed;

DIR *opendir(const char *path)
{
    static DIR *(*real)(const char *);
    if (!real) real = (DIR *(*)(const char *))dlsym(RTLD_NEXT, "opendir");
    DIR *d = real(path);
    if (rig && d && !strcmp(path, "/dev")) { devices = d; listed = 0; }
    return d;
}

struct dirent *readdir(DIR *d)
{
    static struct dirent *(*real)(DIR *), extra;
    if (!real) real = (struct dirent *(*)(DIR *))dlsym(RTLD_NEXT, "readdir");
    struct dirent *entry;
    do entry = real(d); while (entry && d == devices && !strncmp(entry->d_name, "fw", 2));
    if (entry || d != devices || listed >= (rig->unplugged ? 1 : NODES)) return entry;
    memset(&extra, 0, sizeof extra);
    extra.d_ino = 1;
    extra.d_type = DT_CHR;
    strcpy(extra.d_name, listed++ ? "fw1" : "fw0");
    return &extra;
}
struct dirent64 *readdir64(DIR *d) { return (struct dirent64 *)readdir(d); }
