// Preloaded into Betaflight's SITL, gives it a clock that its main thread moves on by reading it and by sleeping: freely
// until the first state of the vehicle, and from then on no farther than the newest one. However busy the machine is, the
// firmware does the same in each step. With the machine's clock, its scheduler stands still for ever if the machine takes
// the processor away from it for 250 us when it starts.
//
// The thread that serves its serial lines over TCP waits until the main thread has opened them: it frees all streams that
// are closed, as those are that the main thread is about to open, which then never answer.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { STATE_BYTES = 144, READING = 100 };  // ns that reading the clock takes
#define SECOND INT64_C(1000000000)

static _Atomic int64_t now = SECOND, until = INT64_MAX;  // ns
static _Atomic int64_t opened = INT64_MAX;  // when the main thread last opened a line
static _Thread_local double newest = -1;  // time (s) of a state that its thread is still storing

static void pass(int64_t ns) {
    if (getpid() != gettid()) return;
    now += ns;
    while (now > until) usleep(20);
}

int clock_gettime(clockid_t id, struct timespec *ts) {
    (void)id;  // the firmware reads one clock only
    pass(READING);
    int64_t time = now;
    ts->tv_sec = time / SECOND;
    ts->tv_nsec = time % SECOND;
    return 0;
}

int nanosleep(const struct timespec *time, struct timespec *rest) {
    static uint32_t more = 1;  // who sleeps wakes up a little late, which scheduling is made for
    (void)rest;
    more = more * 1664525 + 1013904223;
    if (until == INT64_MAX) usleep(time->tv_sec * 1000000 + time->tv_nsec / 1000);
    pass(time->tv_sec * SECOND + time->tv_nsec + more % 16384);
    return 0;
}

ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length) {
    static ssize_t (*receive)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
    if (!receive) receive = dlsym(RTLD_NEXT, "recvfrom");
    ssize_t received = receive(fd, data, size, flags, from, length);
    if (received == STATE_BYTES) {
        memcpy(&newest, data, sizeof newest);
        memset(data, 0, sizeof newest);  // else the firmware changes the rate of its clock
    }
    return received;
}

int listen(int fd, int backlog) {
    static int (*wait)(int, int);
    if (!wait) wait = dlsym(RTLD_NEXT, "listen");
    int result = wait(fd, backlog);
    opened = now;
    return result;
}

int select(int n, fd_set *reading, fd_set *writing, fd_set *failing, struct timeval *timeout) {
    static int (*wait)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
    static int64_t began;
    if (!wait) wait = dlsym(RTLD_NEXT, "select");
    // The threads for the vehicle's state only read
    while ((writing || !reading) && now - SECOND / 2 < opened) usleep(100);
    if (newest >= 0) {  // its thread has stored it, and waits for the next one
        if (!began) began = now;
        until = began + (int64_t)(newest * 1e9 + 0.5);
        newest = -1;
    }
    return wait(n, reading, writing, failing, timeout);
}
