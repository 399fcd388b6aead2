// Search where the site is opened as files: browsers refuse workers there, so a hidden frame takes their place.
// The theme looks for the name IFrameWorker to know that scripts load asynchronously.
if (location.protocol === "file:") {
  const load = (...urls) =>
    urls.reduce(
      (before, url) =>
        before.then(
          () =>
            new Promise((resolve, reject) => {
              const script = document.createElement("script");
              script.src = url;
              script.onload = resolve;
              script.onerror = reject;
              document.body.appendChild(script);
            })
        ),
      Promise.resolve()
    );

  class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.ready = new Promise((resolve) => (frame.onload = resolve));
      addEventListener("message", (event) => {
        if (event.source !== frame.contentWindow) return;
        const copy = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(copy);
        if (this.onmessage) this.onmessage(copy);
      });
      frame.srcdoc =
        "<body><script>" +
        "var IFrameWorker = true; var importScripts = " + load + ";" +
        "postMessage = (data) => parent.postMessage(data, '*');" +
        `<\/script><script src="${url}"><\/script></body>`;
      document.body.appendChild(frame);
      this.frame = frame;
    }

    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  }

  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
}
