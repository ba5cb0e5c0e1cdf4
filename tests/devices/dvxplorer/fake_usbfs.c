/* A USB device that is a program: lets a driver with its own libusb talk to tests/devices/dvxplorer/test_libusb.py.

   Preloaded (LD_PRELOAD) into the driver's process it stands in for what libusb asks of Linux: libudev and the folder
   of devices in /sys name one device, whose files come from the folder FAKE_USBFS_ROOT, and requests to its node in /dev
   go to the socket FAKE_USBFS_SOCKET, one connection for each endpoint: kind, length and setup packet out, status,
   length and data back. */

#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/usbdevice_fs.h>
#include <poll.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/vfs.h>
#include <unistd.h>

#define NODE "/dev/bus/usb/009/002"
#define SYSFS "/sys/bus/usb/devices"
#define SYSFS_MAGIC 0x62656572
#define URBS 256

enum { CONTROL, BULK, ENDPOINTS, CLEAR_HALT = ENDPOINTS };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static int node = -1;                          /* counts the transfers that are done (a semaphore) */
static struct usbdevfs_urb *waiting[ENDPOINTS][URBS], *idle[URBS], *done[URBS];
static int waiting_count[ENDPOINTS], idle_count, done_count, started;
static unsigned char kept[1 << 18]; /* came for a transfer that was given up meanwhile: belongs to the next */
static int kept_count;

static int append(struct usbdevfs_urb **list, int *count, struct usbdevfs_urb *urb) {
    if (*count == URBS) { errno = ENOMEM; return -1; }
    list[(*count)++] = urb;
    return 0;
}

static int take_out(struct usbdevfs_urb **list, int *count, struct usbdevfs_urb *urb) {
    for (int k = 0; k < *count; k++)
        if (list[k] == urb) {
            memmove(list + k, list + k + 1, (--*count - k) * sizeof *list);
            return 1;
        }
    return 0;
}

static void finish(struct usbdevfs_urb *urb, int status, int length) { /* with the lock */
    uint64_t one = 1;
    urb->status = status;
    urb->actual_length = length;
    append(done, &done_count, urb);
    if (write(node, &one, sizeof one) < 0) perror("fake_usbfs");
}

static void transfer_all(int to, void *data, size_t length, int out) {
    for (size_t at = 0; at < length;) {
        ssize_t n = out ? send(to, (char *)data + at, length - at, MSG_NOSIGNAL) : recv(to, (char *)data + at, length - at, 0);
        if (n <= 0) pthread_exit(NULL); /* the test is over */
        at += n;
    }
}

static int connected(void) {
    int peer = socket(AF_UNIX, SOCK_STREAM, 0);
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    strncpy(address.sun_path, getenv("FAKE_USBFS_SOCKET"), sizeof address.sun_path - 1);
    if (connect(peer, (struct sockaddr *)&address, sizeof address)) perror("fake_usbfs");
    return peer;
}

static void clear_halt(void) {
    uint32_t request[4] = {CLEAR_HALT};
    int32_t answer[2];
    int peer = connected();
    transfer_all(peer, request, sizeof request, 1);
    transfer_all(peer, answer, sizeof answer, 0);
    close(peer);
}

static void *endpoint(void *number) {
    int which = (int)(intptr_t)number, peer = connected();
    for (;;) {
        pthread_mutex_lock(&lock);
        while (!waiting_count[which]) pthread_cond_wait(&changed, &lock);
        struct usbdevfs_urb *urb = waiting[which][0];
        unsigned char *setup = urb->buffer, *data = setup + (which == CONTROL ? 8 : 0);
        int length = urb->buffer_length - (which == CONTROL ? 8 : 0);
        int in = which == BULK || setup[0] & 0x80;
        if (which == BULK && kept_count) {
            int count = kept_count < length ? kept_count : length;
            memcpy(data, kept, count);
            memmove(kept, kept + count, kept_count -= count);
            take_out(waiting[which], &waiting_count[which], urb);
            finish(urb, 0, count);
            pthread_mutex_unlock(&lock);
            continue;
        }
        pthread_mutex_unlock(&lock);
        uint32_t request[4] = {which, length, 0, 0};
        if (which == CONTROL) memcpy(request + 2, setup, 8);
        int32_t answer[2];
        transfer_all(peer, request, sizeof request, 1);
        if (!in) transfer_all(peer, data, length, 1);
        transfer_all(peer, answer, sizeof answer, 0);
        unsigned char received[1 << 17];
        if (in) transfer_all(peer, received, answer[1], 0);
        pthread_mutex_lock(&lock);
        if (take_out(waiting[which], &waiting_count[which], urb)) {
            if (in) memcpy(data, received, answer[1]);
            if (answer[0] == -ETIMEDOUT) append(waiting[which], &waiting_count[which], urb); /* goes on waiting */
            else finish(urb, answer[0], answer[1]);
        } else if (which == BULK && kept_count + answer[1] <= (int)sizeof kept) {
            memcpy(kept + kept_count, received, answer[1]);
            kept_count += answer[1];
        }
        pthread_mutex_unlock(&lock);
    }
    return NULL;
}

static int node_ioctl(unsigned long request, void *argument) {
    int result = 0;
    uint64_t one;
    struct usbdevfs_urb *urb = argument;
    pthread_mutex_lock(&lock);
    switch (request) {
    case USBDEVFS_GET_CAPABILITIES:
        *(uint32_t *)argument = USBDEVFS_CAP_NO_PACKET_SIZE_LIM;
        break;
    case USBDEVFS_SUBMITURB:
        if (urb->type == USBDEVFS_URB_TYPE_INTERRUPT) result = append(idle, &idle_count, urb);
        else {
            int which = urb->type == USBDEVFS_URB_TYPE_CONTROL ? CONTROL : BULK;
            result = append(waiting[which], &waiting_count[which], urb);
        }
        pthread_cond_broadcast(&changed);
        break;
    case USBDEVFS_DISCARDURB:
        if (take_out(waiting[CONTROL], &waiting_count[CONTROL], urb) || take_out(waiting[BULK], &waiting_count[BULK], urb) ||
            take_out(idle, &idle_count, urb))
            finish(urb, -ENOENT, 0);
        else { errno = EINVAL; result = -1; }
        break;
    case USBDEVFS_REAPURBNDELAY:
        if (!done_count) { errno = EAGAIN; result = -1; }
        else {
            *(struct usbdevfs_urb **)argument = done[0];
            take_out(done, &done_count, done[0]);
            if (read(node, &one, sizeof one) < 0) perror("fake_usbfs");
        }
        break;
    case USBDEVFS_GETDRIVER:
        errno = ENODATA;
        result = -1;
        break;
    case USBDEVFS_CLAIMINTERFACE: case USBDEVFS_RELEASEINTERFACE: case USBDEVFS_SETCONFIGURATION:
    case USBDEVFS_SETINTERFACE: case USBDEVFS_RESET: case USBDEVFS_DISCONNECT_CLAIM:
        break;
    case USBDEVFS_CLEAR_HALT:
        pthread_mutex_unlock(&lock);
        clear_halt();
        return 0;
    default:
        errno = ENOTTY;
        result = -1;
    }
    pthread_mutex_unlock(&lock);
    return result;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static const char *moved(const char *path, char *buffer, size_t size) {
    if (strncmp(path, SYSFS, strlen(SYSFS))) return path;
    snprintf(buffer, size, "%s%s", getenv("FAKE_USBFS_ROOT"), path + strlen(SYSFS));
    return buffer;
}

DIR *opendir(const char *path) {
    char buffer[4096];
    return REAL(opendir)(moved(path, buffer, sizeof buffer));
}

int open(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    char buffer[4096];
    if (!strcmp(path, NODE)) {
        pthread_mutex_lock(&lock);
        node = eventfd(0, EFD_SEMAPHORE | EFD_CLOEXEC | EFD_NONBLOCK);
        for (; started < ENDPOINTS; started++) {
            pthread_t thread;
            pthread_create(&thread, NULL, endpoint, (void *)(intptr_t)started);
        }
        pthread_mutex_unlock(&lock);
        return node;
    }
    return REAL(open)(moved(path, buffer, sizeof buffer), flags, mode);
}

int close(int fd) {
    pthread_mutex_lock(&lock);
    if (fd == node && fd >= 0) {
        node = -1;
        done_count = idle_count = waiting_count[CONTROL] = waiting_count[BULK] = kept_count = 0;
    }
    pthread_mutex_unlock(&lock);
    return REAL(close)(fd);
}

int ioctl(int fd, unsigned long request, ...) {
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    return fd == node && fd >= 0 ? node_ioctl(request, argument) : REAL(ioctl)(fd, request, argument);
}

#pragma GCC diagnostic ignored "-Wmaybe-uninitialized" /* the header says that poll only writes */
int poll(struct pollfd *fds, nfds_t count, int timeout) {
    nfds_t at = count;
    for (nfds_t k = 0; k < count; k++)
        if (fds[k].fd == node && node >= 0) at = k;
    if (at < count) fds[at].events = POLLIN;
    int result = REAL(poll)(fds, count, timeout);
    if (at < count) {
        fds[at].events = POLLOUT;
        if (fds[at].revents & POLLIN) fds[at].revents = POLLOUT;
    }
    return result;
}

int statfs(const char *path, struct statfs *about) {
    if (strcmp(path, "/sys")) return REAL(statfs)(path, about);
    memset(about, 0, sizeof *about);
    about->f_type = SYSFS_MAGIC;
    return 0;
}

/* libudev, as far as libusb uses it. */
static char something;
void *udev_new(void) { return &something; }
void *udev_unref(void *udev) { return NULL; }
void *udev_monitor_new_from_netlink(void *udev, const char *name) { return &something; }
int udev_monitor_filter_add_match_subsystem_devtype(void *monitor, const char *subsystem, const char *type) { return 0; }
int udev_monitor_enable_receiving(void *monitor) { return 0; }
int udev_monitor_get_fd(void *monitor) { return eventfd(0, 0); }
void *udev_monitor_receive_device(void *monitor) { return NULL; }
void *udev_monitor_unref(void *monitor) { return NULL; }
void *udev_enumerate_new(void *udev) { return &something; }
int udev_enumerate_add_match_subsystem(void *all, const char *subsystem) { return 0; }
int udev_enumerate_add_match_property(void *all, const char *name, const char *value) { return 0; }
int udev_enumerate_scan_devices(void *all) { return 0; }
void *udev_enumerate_get_list_entry(void *all) { return &something; }
void *udev_enumerate_unref(void *all) { return NULL; }
void *udev_list_entry_get_next(void *entry) { return NULL; }
const char *udev_list_entry_get_name(void *entry) { return "/sys/devices/9-1"; }
void *udev_device_new_from_syspath(void *udev, const char *path) { return &something; }
const char *udev_device_get_devnode(void *device) { return NODE; }
const char *udev_device_get_sysname(void *device) { return "9-1"; }
const char *udev_device_get_action(void *device) { return NULL; }
void *udev_device_unref(void *device) { return NULL; }
