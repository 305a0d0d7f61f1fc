// Entry of the kernel on a CPU: threads take environments from a queue, a share of them at a time.
struct Queue { const Problem* problem; int environments, share, next; };

static void* work(void* shared) {
    Queue& queue = *static_cast<Queue*>(shared);
    for (int first; (first = __atomic_fetch_add(&queue.next, queue.share, __ATOMIC_RELAXED)) < queue.environments;) {
        for (int index = first; index < first + queue.share && index < queue.environments; index++) {
            Lanes lanes = {0, false};
            Environment env;
            roll(*queue.problem, index, lanes, env);
        }
    }
    return nullptr;
}

extern "C" void run(int threads, int share, PARAMETERS) {
    const Problem problem = PROBLEM;
    Queue queue = {&problem, environments, share, 0};
    pthread_t* others = new pthread_t[threads];
    int count = 0;  // where the system gives no more threads, those that there are do the work
    while (count + 1 < threads && pthread_create(&others[count], nullptr, work, &queue) == 0) count++;
    work(&queue);
    while (count > 0) pthread_join(others[--count], nullptr);
    delete[] others;
}
